"""The part of the page that shows a model's predictions, and renders them from the browser's viewpoint."""

import math
import threading
from typing import Literal, cast

import numpy as np
import torch
import viser
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from viser.transforms import SO3

from foredrive.geometry.boxes import EDGES, box_corners
from foredrive.runs.evaluate.display import DisplayPrediction
from foredrive.scene import CameraRig, VoxelSpec
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy
from foredrive.tasks.occupancy.scores import ABOVE_GROUND_M
from foredrive.view import palette
from foredrive.view.image_drawing import to_image
from foredrive.view.log_frames import LogFrames
from foredrive.view.scene_nodes import FRUSTUM_M, clear, show_path
from foredrive.view.task_pictures import MIN_SCORE, STILL_M, found_agents, voxel_colours
from foredrive.view.voxel_drawing import height_colours, pca_colours

ColourBy = Literal["height", "features", "classes"]
BESIDE_M = 4.0
"""Distance between predicted and true voxels, m."""
FILL = 0.94
"""Edge of a drawn cube relative to its voxel; below 1, so that neighbours stay apart."""
MOVES_M = 0.25
"""Minimum length of a drawn arrow, m."""
ARROW_WIDTH, HEAD_SHARE = 3.0, 0.3

_CUBE = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_CUBE_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ]
)  # fmt: skip


def shown_voxels(
    prediction: DisplayPrediction, k: int, spec: VoxelSpec, above: float, min_height_m: float
) -> Bool[Tensor, "Z Y X"]:
    """Return the voxels of frame k that are occupied with a probability of more than `above`.

    Args:
        min_height_m: minimum height of voxel centres in the ego frame; the road would hide many other voxels.
    """
    z = spec.centres_m()[..., 2]
    return (prediction.occupancy_logit[k].sigmoid() > above) & (z >= min_height_m)


def show_occupancy(
    scene: viser.SceneApi,
    prediction: DisplayPrediction,
    k: int,
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
    colour_by: ColourBy,
) -> None:
    """Draw voxels of frame k as cubes in the ego frame now, where the model expects them.

    Classes are those of now; later frames have the colours of height instead.
    """
    colours: UInt8[np.ndarray, "Z Y X 3"] = height_colours(spec)
    if colour_by == "features":
        colours = pca_colours(prediction.volume[k], shown)
    elif colour_by == "classes" and k == 0 and prediction.classes is not None:
        colours = voxel_colours(prediction.taxonomy)[prediction.classes.numpy()]
    return _show_cubes(scene, "/occupancy", prediction.T_now_ego[k], spec, shown, colours)


def show_true_classes(
    scene: viser.SceneApi,
    classes: UInt8[Tensor, "Z Y X"] | None,
    taxonomy: Taxonomy,
    spec: VoxelSpec,
    min_height_m: float,
) -> None:
    """Draw the recorded voxels of now in the colours of their classes, to the left of the scene."""
    if classes is None:
        return clear(scene, "/true voxels")
    # The last class is free space
    shown = (classes != len(VOXEL_CLASSES[taxonomy]) - 1) & (spec.centres_m()[..., 2] >= min_height_m)
    # Shifted to the left by the width of the grid and a gap
    beside = torch.eye(4)
    beside[1, 3] = spec.upper_m[1] - spec.lower_m[1] + BESIDE_M
    return _show_cubes(scene, "/true voxels", beside, spec, shown, voxel_colours(taxonomy)[classes.numpy()])


def _show_cubes(
    scene: viser.SceneApi,
    name: str,
    T_now_ego: Float[Tensor, "4 4"],
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
    colours: UInt8[np.ndarray, "Z Y X 3"],
) -> None:
    pose, count = T_now_ego.double().numpy(), int(shown.sum())
    if count == 0:
        return clear(scene, name)
    scene.add_batched_meshes_simple(
        name,
        FILL * spec.voxel_m * _CUBE,
        _CUBE_FACES,
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        batched_positions=spec.centres_m()[shown].numpy(),
        batched_colors=colours[shown.numpy()],
        flat_shading=True,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
        position=pose[:3, 3],
    )
    return None


def show_flow(
    scene: viser.SceneApi,
    prediction: DisplayPrediction,
    k: int,
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
) -> None:
    """Draw the movement of shown voxels since frame k - 1 as arrows over the ground; none for now."""
    movement = None if k == 0 else prediction.movement_m(k, spec)
    if movement is None:
        return clear(scene, "/flow")
    start, end = movement
    moves = shown & ((end - start).norm(dim=-1) > MOVES_M)
    if not bool(moves.any()):
        return clear(scene, "/flow")
    ends = arrows(start[moves], end[moves])
    lift = torch.tensor([0.0, 0.0, 0.75 * spec.voxel_m])  # On top of the cubes, not inside
    scene.add_line_segments(
        "/flow",
        (ends + lift).numpy(),
        np.array(palette.rgb255(palette.FALSE_POSITIVE)),
        line_width=ARROW_WIDTH,
    )
    return None


def arrows(start: Float[Tensor, "N 3"], end: Float[Tensor, "N 3"]) -> Float[Tensor, "N3 2 3"]:
    """Return three segments for each of N arrows with flat heads, the shaft first."""
    along = end - start
    # Horizontally across the arrow, as long as the arrow seen from above
    across = torch.stack([-along[:, 1], along[:, 0], torch.zeros_like(along[:, 0])], dim=-1)
    back = end - HEAD_SHARE * along
    heads = [back + 0.5 * HEAD_SHARE * across, back - 0.5 * HEAD_SHARE * across]
    return torch.stack([torch.stack([start, *heads], 1), end[:, None].expand(-1, 3, 3)], 2).flatten(0, 1)


BOXES, MAP = "/found boxes", "/found map"
LIFT_M = 0.1
"""Height of lines above the ground, m."""


def show_agents(scene: viser.SceneApi, agents: Agents | None) -> None:
    """Draw likely road users of an unbatched frame as thin boxes, each with its name and likely futures."""
    clear(scene, BOXES)
    agents_found = None if agents is None else found_agents(agents)
    if agents_found is None or not len(agents_found.names):
        return
    boxes = agents_found.boxes
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)
    # With the diagonals of the front face
    edges = torch.tensor([*EDGES, (0, 5), (1, 4)])
    pieces, colours = [], []
    for n, kind in enumerate(boxes.category.tolist()):
        colour = palette.rgb255(palette.box_colour(kind))
        x, y, z = boxes.centre[n].tolist()
        lines = [corners[n][edges].numpy()]
        for xy, _ in agents_found.futures[n]:
            if np.linalg.norm(xy[-1] - (x, y)) >= STILL_M:
                path = np.concatenate([[(x, y)], xy])
                path = np.concatenate([path, np.full((len(path), 1), z)], axis=1)
                lines.append(np.stack([path[:-1], path[1:]], axis=1))
        pieces += lines
        colours += [np.tile(np.array(colour), (len(line), 2, 1)) for line in lines]
    scene.add_frame(BOXES, show_axes=False)
    scene.add_line_segments(f"{BOXES}/lines", np.concatenate(pieces), np.concatenate(colours), line_width=1.5)
    tops = boxes.centre[:, 2] + 0.5 * boxes.size_lwh[:, 2] + 0.3
    for n, name in enumerate(agents_found.names):
        x, y, _ = boxes.centre[n].tolist()
        scene.add_label(f"{BOXES}/name {n}", name, position=(x, y, float(tops[n])))


def show_lines(scene: viser.SceneApi, lines: MapLines | None) -> None:
    """Draw likely map elements of an unbatched frame on the ground."""
    kept = None if lines is None else lines[lines.score >= MIN_SCORE]
    if kept is None or not len(kept.score):
        return clear(scene, MAP)
    points = torch.nn.functional.pad(kept.points, (0, 1), value=LIFT_M)
    pieces = torch.stack([points[:, :-1], points[:, 1:]], dim=2)
    colours = np.array(
        [palette.rgb255(palette.ELEMENT_COLOURS[ElementKind(kind)]) for kind in kept.kind.tolist()]
    )
    line_colours = np.broadcast_to(colours[:, None, None], (*pieces.shape[:3], 3)).reshape(-1, 2, 3)
    scene.add_line_segments(MAP, pieces.flatten(0, 1).numpy(), line_colours, line_width=4.0)
    return None


RENDERED_HEIGHT_PX = 160
NODES = ("occupancy", "flow", "plan")
TASK_NODES = ("found boxes", "found map", "true voxels")
"""Shown where the run has task heads."""


class ModelPanel:
    """Controls and nodes of one run's model.

    Args:
        server: server of the page.
        frames: a log with a run.
    """

    def __init__(self, server: viser.ViserServer, frames: LogFrames) -> None:
        assert frames.run is not None
        assert frames.predictor is not None
        self._server, self._frames, self._predictor = server, frames, frames.predictor
        self.spec, self._dt_s = frames.run.recipe.clips.voxels, frames.run.recipe.clips.frame_dt_s
        self._index, self._drawing = 0, threading.Lock()
        gui, steps, spec = server.gui, self._predictor.steps, self.spec
        low_m, high_m = spec.lower_m[2], spec.upper_m[2] - spec.voxel_m
        # The first step of the slider above the ground
        above_road = low_m + spec.voxel_m * math.ceil((ABOVE_GROUND_M - low_m) / spec.voxel_m)
        with gui.add_folder("Model"):
            self._note = gui.add_markdown("")
            self.frame = gui.add_slider("imagined frame", 0, max(steps, 1), 1, 0, disabled=steps == 0)
            nodes = NODES if self._predictor.heads is None else (*NODES, *TASK_NODES)
            self.boxes = {name: gui.add_checkbox(name, True) for name in nodes}
            ways = ("height", "features") if frames.taxonomy is None else ("classes", "height", "features")
            self.colour_by = gui.add_dropdown("coloured by", ways)
            self.above = gui.add_slider("probability >", 0.05, 0.95, 0.05, 0.5)
            self.min_height_m = gui.add_slider(
                "height, m >", low_m, high_m, spec.voxel_m, min(above_road, high_m)
            )
            render = gui.add_button(
                "Render from here",
                hint="render the predicted volume from this viewpoint",
                visible=self._predictor.renders,
            )
            self._rendered = gui.add_image(np.zeros((1, 1, 3), np.uint8), visible=False)
        for slider in (self.frame, self.above, self.min_height_m):
            slider.on_update(lambda _: self.show(self._index))
        for box in self.boxes.values():
            box.on_update(lambda _: self.show(self._index))
        self.colour_by.on_update(lambda _: self.show(self._index))
        render.on_click(self._render_from)

    def show(self, index: int) -> None:
        """Draw the model's predictions at a frame of the log."""
        # Handlers of the page run in several threads; one drawing at a time
        with self._drawing:
            self._index = index
            prediction, k, scene = self._frames.prediction(index), self.frame.value, self._server.scene
            self._note.content = self._when(k) if prediction is not None else "too few frames before this one"
            with self._server.atomic():
                if prediction is not None:
                    spec = self.spec
                    shown = shown_voxels(prediction, k, spec, self.above.value, self.min_height_m.value)
                    colour_by = cast(ColourBy, self.colour_by.value)
                    show_occupancy(scene, prediction, k, spec, shown, colour_by)
                    show_flow(scene, prediction, k, spec, shown)
                    show_path(scene, "plan", prediction.plan, palette.PLAN)
                    self._show_tasks(prediction)
                for name, box in self.boxes.items():
                    node = scene.get_handle_by_name(f"/{name}")
                    if node is not None:
                        node.visible = box.value and prediction is not None

    def _show_tasks(self, prediction: DisplayPrediction) -> None:
        """Draw the results of the task heads now, and the true voxels next to them."""
        scene = self._server.scene
        show_agents(scene, prediction.agents)
        show_lines(scene, prediction.lines)
        if self._frames.taxonomy is not None:
            true = self._frames.true_classes(self._index)
            show_true_classes(scene, true, self._frames.taxonomy, self.spec, self.min_height_m.value)

    def _when(self, k: int) -> str:
        return f"imagined, **{k * self._dt_s:g} s** ahead" if k else "observed **now**"

    def _render_from(self, event: viser.GuiEvent) -> None:
        """Render from the viewpoint of the browser that pressed the button, and keep the picture there."""
        if event.client is None:
            return
        with self._drawing:
            prediction, k = self._frames.prediction(self._index), self.frame.value
            if prediction is None:
                return
            camera = event.client.camera
            T_now_cam = np.eye(4)
            T_now_cam[:3, :3], T_now_cam[:3, 3] = SO3(camera.wxyz).as_matrix(), camera.position
            # An imagined volume is in the ego frame of its own time, the browser's camera in that of now
            T_ego_cam = np.linalg.inv(prediction.T_now_ego[k].double().numpy()) @ T_now_cam
            rig = pinhole(T_ego_cam, camera.fov, camera.aspect, RENDERED_HEIGHT_PX)
            rgb = to_image(self._predictor.render(prediction, k, rig)[0].permute(2, 0, 1))
        self._rendered.image, self._rendered.visible = rgb, True
        self._server.scene.add_camera_frustum(
            "/rendered",
            fov=camera.fov,
            aspect=camera.aspect,
            scale=FRUSTUM_M,
            color=palette.rgb255(palette.PLAN),
            image=rgb,
            wxyz=camera.wxyz,
            position=camera.position,
        )


def pinhole(
    T_ego_cam: Float[np.ndarray, "4 4"], fov_y_rad: float, aspect: float, height_px: int
) -> CameraRig:
    """Return an ideal pinhole camera with this vertical field of view, without leading dimensions."""
    width_px = max(round(aspect * height_px), 1)
    focal = height_px / 2 / float(np.tan(fov_y_rad / 2))
    return CameraRig(
        K=torch.tensor([[[focal, 0.0, width_px / 2], [0.0, focal, height_px / 2], [0.0, 0.0, 1.0]]]),
        T_ego_cam=torch.from_numpy(T_ego_cam).float()[None],
        dist=torch.zeros(1, 5),
        readout_s=torch.zeros(1),
        names=("here",),
        size_hw=(height_px, width_px),
    )
