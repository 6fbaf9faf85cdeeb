"""Nodes of a 3-D scene: points, boxes, map, cameras, paths, all in the ego frame at now.

Every function replaces the nodes that it drew before under the same name, and removes them if there is
nothing to draw.
"""

import numpy as np
import torch
import viser
from jaxtyping import Float, UInt8
from torch import Tensor
from viser.transforms import SO3

from foredrive.geometry.boxes import EDGES, box_corners
from foredrive.scene import CameraRig, Clip, MapKind, Trajectory
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY, path_points

CAMERAS = "/cameras"
POINT_M = 0.06
FRUSTUM_M = 1.2
EGO_HEIGHT_M = 1.5
PATH_LIFT_M = 0.15
"""Height of paths above the ground, m; at 0 the road would hide half of them."""


def show_lidar(scene: viser.SceneApi, clip: Clip) -> None:
    """Draw returns, near ones bright."""
    sweep = clip.sweeps[clip.now]
    returned = sweep.returned & sweep.valid
    if not bool(returned.any()):
        return clear(scene, "/lidar")
    scene.add_point_cloud(
        "/lidar",
        sweep.points_ego[returned].numpy(),
        palette.range_colours(sweep.range_m[returned].numpy()),
        point_size=POINT_M,
        point_shape="circle",
    )
    return None


def show_boxes(scene: viser.SceneApi, clip: Clip) -> None:
    """Draw wire frames in the colours of their kinds, a cross on the front of each."""
    boxes = clip.boxes[clip.now]
    boxes = boxes[boxes.valid]
    edges = torch.tensor([*EDGES, (0, 5), (1, 4)])  # With the diagonals of the front face
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
    colours = np.array([palette.rgb255(palette.box_colour(kind)) for kind in boxes.category.tolist()])
    line_colours = np.repeat(colours.reshape(-1, 3), 2 * len(edges), axis=0)
    _lines(scene, "/boxes", corners[:, edges].flatten(0, 1), line_colours.reshape(-1, 2, 3), width=2.5)


def show_map(scene: viser.SceneApi, clip: Clip) -> None:
    """Draw polylines in the colours of their kinds."""
    if clip.map is None:
        return clear(scene, "/map")
    # A piece of a line is drawn if both of its ends are valid
    both = clip.map.valid[:, 1:] & clip.map.valid[:, :-1]
    pieces = torch.stack([clip.map.vertices[:, :-1], clip.map.vertices[:, 1:]], dim=2)[both]
    kinds = clip.map.kind[:, None].expand(both.shape)[both].tolist()
    colours = np.array([palette.rgb255(palette.MAP_COLOURS[MapKind(kind)]) for kind in kinds])
    _lines(scene, "/map", pieces, np.repeat(colours.reshape(-1, 1, 3), 2, axis=1), width=2.0)
    return None


def show_cameras(scene: viser.SceneApi, clip: Clip) -> None:
    """Draw every camera with an image as a frustum with the image in it, without lens distortion."""
    rig, now = clip.rig[clip.now], clip.now
    for c, name in enumerate(rig.names):
        if bool(clip.image_valid[now, c]):
            show_camera(scene, rig, c, clip.images[now, c].permute(1, 2, 0).numpy())
        else:
            clear(scene, f"{CAMERAS}/{name}")


def show_camera(scene: viser.SceneApi, rig: CameraRig, index: int, image: UInt8[np.ndarray, "H W 3"]) -> None:
    """Draw one camera of a rig without leading dimensions."""
    height, width = rig.size_hw
    pose = rig.T_ego_cam[index].double().numpy()
    scene.add_camera_frustum(
        f"{CAMERAS}/{rig.names[index]}",
        # The vertical field of view, for a principal point in the middle
        fov=2 * float(np.arctan(height / 2 / float(rig.K[index, 1, 1]))),
        aspect=width / height,
        scale=FRUSTUM_M,
        color=palette.rgb255(palette.FAINT),
        image=image,
        jpeg_quality=85,
        wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
        position=pose[:3, 3],
        cast_shadow=False,
        receive_shadow=False,
    )


def show_path(scene: viser.SceneApi, name: str, path: Trajectory, colour: str) -> None:
    """Draw a trajectory's first alternative from the rear axle on, a ball at each valid waypoint."""
    points = path_points(path) + torch.tensor([0.0, 0.0, PATH_LIFT_M])
    if len(points) < 2:
        return clear(scene, f"/{name}")
    rgb = palette.rgb255(colour)
    _lines(scene, f"/{name}", torch.stack([points[:-1], points[1:]], dim=1), np.array(rgb), width=7.0)
    scene.add_point_cloud(
        f"/{name}/waypoints", points[1:].numpy(), np.array(rgb), point_size=0.22, point_shape="circle"
    )
    return None


def show_ego(scene: viser.SceneApi) -> None:
    """Draw the ego vehicle as a prism over its footprint."""
    count = len(EGO_OUTLINE_XY)
    bottom = np.column_stack([EGO_OUTLINE_XY, np.full(count, 0.25)])
    top = np.column_stack([EGO_OUTLINE_XY, np.full(count, EGO_HEIGHT_M)])
    side = [(i, (i + 1) % count) for i in range(count)]
    # Top and bottom are fans of triangles around one corner, each side is two triangles
    faces = [(0, i, i + 1) for i in range(1, count - 1)] + [
        (count, count + i + 1, count + i) for i in range(1, count - 1)
    ]
    faces += [face for i, j in side for face in ((i, i + count, j), (j, i + count, j + count))]
    scene.add_mesh_simple(
        "/ego",
        np.concatenate([bottom, top]),
        np.array(faces),
        color=palette.rgb255(palette.EGO),
        opacity=0.85,
        flat_shading=True,
        side="double",
        cast_shadow=False,
    )


def _lines(
    scene: viser.SceneApi, name: str, ends: Float[Tensor, "N 2 3"], colours: np.ndarray, width: float
) -> None:
    if len(ends) == 0:
        return clear(scene, name)
    scene.add_line_segments(name, ends.numpy(), colours, line_width=width)
    return None


def clear(scene: viser.SceneApi, name: str) -> None:
    """Remove a node, if it exists."""
    if scene.get_handle_by_name(name) is not None:
        scene.remove_by_name(name)
