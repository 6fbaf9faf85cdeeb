"""A picture of a safety test: a camera's view shortly before the impact, and the paths from above."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.dynamics import yaw_rate_radps
from foredrive.driving.ncap.drawing import draw_run
from foredrive.driving.ncap.placing import place_actors, way_points
from foredrive.driving.ncap.proposing import Approach
from foredrive.driving.ncap.running import Place
from foredrive.driving.ncap.scenario import SafetyScenario
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.reconstruction.tracks import boxes_at
from foredrive.scene import CameraRig
from foredrive.view import palette
from foredrive.view.bev import draw_boxes, draw_ego, start_bev
from foredrive.view.image_drawing import Camera, draw_boxes_on_image, resize
from foredrive.view.sheet import Sheet

IMPACT_S = Approach().impact_s
"""Time from the end of the priming to the impact of a vehicle that takes no action, s."""
BEFORE_S = 1.5
"""Time from the picture to the impact of a vehicle that takes no action, s."""
REACH_M = 40.0
HEIGHT_PX, HEAD_PX, MARGIN_PX = 400, 44, 12
AXES_PX = 52
"""Space for the labels of the view from above, px."""


def write_scenario_picture(path: Path, place: Place, scenario: SafetyScenario) -> None:
    """Write a picture of the first run of a scenario, with the ego vehicle on the logged path.

    The image is that of the camera that looks most directly at the target. Its box is drawn in it.
    """
    drawn, drive = draw_run(scenario, 0), LoggedDrive(place.vehicle, torch.eye(4))
    graph = place_actors(place.graph, drawn, place.vehicle.T_world_scene, place.track_ids, moving_stay=True)
    # The run begins after the priming frames, and an ego vehicle without action is hit after `IMPACT_S`
    at_s = FRAME_DT_S * (drawn.start_frame + scenario.priming_frames) + IMPACT_S - BEFORE_S
    T_world_ego, ego = torch.from_numpy(drive.pose_at(at_s)), drive.state_at(at_s)
    renderer = place.renderer(graph)
    twist = torch.tensor([ego.speed_mps, 0.0, 0.0, 0.0, 0.0, yaw_rate_radps(ego)])
    seen = renderer.render(T_world_ego, twist, at_s)
    tracks = graph.all_tracks.map_tensors(lambda tensor: tensor.detach().cpu())
    T_scene_ego = inverse_se3(place.vehicle.T_world_scene) @ T_world_ego
    boxes = boxes_at(tracks, T_scene_ego, at_s)
    # Boxes that the log does not have are those of the scenario
    added = torch.isin(boxes.track_id, place.graph.all_tracks.track_id.cpu(), invert=True)
    camera = facing(renderer.rig, boxes.centre[added][0].numpy() if bool(added.any()) else np.zeros(3))
    width_px = 0
    picture = None
    if camera is not None:
        image = seen.images[camera].permute(1, 2, 0).numpy()
        width_px = round(HEIGHT_PX * image.shape[1] / image.shape[0])
        shown = Camera.of(renderer.rig, camera).resized((HEIGHT_PX, width_px))
        picture = draw_boxes_on_image(resize(image, shown.size_hw), boxes[added], shown)
    above_x = width_px + 2 * MARGIN_PX + AXES_PX
    sheet = Sheet(above_x + HEIGHT_PX + 2 * MARGIN_PX, HEAD_PX + HEIGHT_PX + AXES_PX)
    sheet.head(MARGIN_PX, HEAD_PX, f"{scenario.label}    {BEFORE_S:g} s before the impact", 13.0)
    if picture is not None:
        axes = sheet.place(MARGIN_PX, HEAD_PX, width_px, HEIGHT_PX)
        axes.imshow(picture, aspect="auto", interpolation="lanczos")
        axes.axis("off")
    above = sheet.place(above_x, HEAD_PX, HEIGHT_PX, HEIGHT_PX)
    start_bev(above, REACH_M)
    logged = drive.path_ahead(T_world_ego.numpy())
    above.plot(logged[:, 1], logged[:, 0], color=palette.EXPERT, linewidth=1.4, zorder=2)
    for actor in drawn.actors:
        times = np.arange(at_s - IMPACT_S, at_s + IMPACT_S, 0.25)
        way = in_ego_frame(way_points(actor.way, times), T_world_ego.numpy())
        above.plot(way[:, 1], way[:, 0], color=palette.PLAN, linewidth=1.4, marker=".", zorder=2)
    draw_boxes(above, boxes)
    draw_ego(above)
    sheet.save(path)


def facing(rig: CameraRig, point_ego: np.ndarray) -> int | None:
    """Return the camera whose optical axis points most directly at a point; None without cameras."""
    if not rig.names:
        return None
    T = rig.T_ego_cam.double().numpy()
    ray = point_ego - T[:, :3, 3]
    off_rad = np.arccos(np.clip((ray * T[:, :3, 2]).sum(1) / np.linalg.norm(ray, axis=1), -1.0, 1.0))
    return int(np.argmin(np.where(np.isnan(off_rad), math.pi, off_rad)))


def in_ego_frame(
    points: Float64[np.ndarray, "N 3"], T_world_ego: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "N 3"]:
    """Return points of the world in the ego frame."""
    moved = transform_points(inverse_se3(torch.from_numpy(T_world_ego)), torch.from_numpy(points))
    return np.asarray(moved.numpy())
