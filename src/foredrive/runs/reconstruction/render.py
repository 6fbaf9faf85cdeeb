"""Render the sensors on a drive through a reconstructed log, with or without edits, time by time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import (
    DriveStraight,
    Duplicate,
    Edit,
    EditedScene,
    Insert,
    Remove,
    ShiftEgo,
)
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.renderer import render_sweep
from foredrive.methods.reconstruction.tracks import ActorTracks, boxes_at
from foredrive.methods.reconstruction.trust import ObservedViews, darkened
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.scene import Boxes, LidarSweep
from foredrive.sensors import SpinningLidar, hdl32e, pandar64, vlp16

LIDARS: dict[str, Callable[[Float[Tensor, "4 4"]], SpinningLidar]] = {
    "pandar64": pandar64,
    "hdl32e": hdl32e,
    "vlp16": vlp16,
}
"""Lidars by name; each is mounted at the pose of the log's lidar."""
_MIN_STEP_S = 1e-3


@dataclass(frozen=True)
class RenderPlan:
    """The plan of a film: its times and its sensors."""

    t_s: tuple[float, ...]
    step_s: float
    cameras: tuple[int, ...]
    """Indices of the cameras in the vehicle's rig."""
    lidar: SpinningLidar | None
    observed: ObservedViews | None = None
    """Training views: what none of them saw is darkened. None: nothing is."""


@dataclass(frozen=True)
class RenderedFrame:
    """The sensor data of one time."""

    t_s: float
    images: UInt8[Tensor, "C 3 H W"]
    sweep: LidarSweep | None
    """The sweep in the ego frame, including beams without a return."""
    boxes: Boxes
    """Boxes of the actors, in the ego frame."""


def plan_frames(
    vehicle: LoggedVehicle,
    cameras: Sequence[str] = (),
    lidar: str | None = None,
    *,
    start_s: float = 0.0,
    seconds: float | None = None,
    rate_hz: float | None = None,
) -> RenderPlan:
    """Plan the times and the sensors of a film.

    Args:
        vehicle: vehicle of the run.
        cameras: names of cameras, in this order; empty: all cameras.
        lidar: a name in `LIDARS`, mounted at the pose of the log's lidar; None: the log's own lidar.
        start_s: start of the film since the start of the log, s.
        seconds: length, s; None: until the end of the log.
        rate_hz: frames per second; None: the rate of the log.

    Raises:
        InputError: a camera or a lidar does not exist, a time is outside the log, or there is nothing to
            film.
    """
    chosen = tuple(vehicle.camera(name) for name in cameras) or tuple(range(len(vehicle.rig.names)))
    beams = vehicle.lidar
    if lidar is not None:
        if lidar not in LIDARS:
            raise InputError(f"no lidar {lidar!r}; there are: {', '.join(LIDARS)}")
        if vehicle.T_ego_lidar is None:
            raise InputError("the log had no lidar, so this scene has no learned lidar")
        beams = LIDARS[lidar](vehicle.T_ego_lidar)
    if not chosen and beams is None:
        raise InputError("there are no cameras to render; choose a lidar with --lidar")
    vehicle.check_time(start_s)
    last_s = float(vehicle.t_s[-1])
    end_s = last_s if seconds is None else start_s + seconds
    vehicle.check_time(end_s)
    steps_s = vehicle.t_s.diff()
    step_s = 1 / rate_hz if rate_hz else float(steps_s.median()) if len(steps_s) else 1.0
    if not (step_s >= _MIN_STEP_S and end_s >= start_s):
        raise InputError(
            f"a video of {end_s - start_s:g} s with {rate_hz or 0:g} frames per second is not possible"
        )
    count = int((end_s - start_s) / step_s + _MIN_STEP_S) + 1
    return RenderPlan(tuple(min(start_s + k * step_s, last_s) for k in range(count)), step_s, chosen, beams)


@torch.no_grad()
def render_frame(
    scene: ReconstructedScene, vehicle: LoggedVehicle, edited: EditedScene, plan: RenderPlan, number: int
) -> RenderedFrame:
    """Render all sensors at one of the times.

    Each camera keeps its exposure delay from the log; the lidar's revolution ends at the time itself.

    Args:
        scene: scene of a run.
        vehicle: vehicle of the run.
        edited: the scene's graph after edits, or without edits (`apply_edits(graph, [])`).
        plan: from `plan_frames`.
        number: index of the time.
    """
    t_s, rig = plan.t_s[number], vehicle.rig
    images = torch.zeros(len(plan.cameras), 3, *rig.size_hw, dtype=torch.uint8)
    assert rig.exposed_dt_s is not None
    for place, camera in enumerate(plan.cameras):
        ego = vehicle.at(t_s + float(rig.exposed_dt_s[camera])).shifted(edited.T_ego_shifted.cpu())
        view = novel_camera_view(rig, camera, ego)
        image = scene.camera(edited.graph, view.to(scene.device))
        if plan.observed is not None:
            image = darkened(plan.observed, scene, edited.graph, view, image)
        images[place] = image.rgb_8bit
    ego, sweep = vehicle.at(t_s).shifted(edited.T_ego_shifted.cpu()), None
    if plan.lidar is not None:
        sweep = render_sweep(scene, edited.graph, plan.lidar, ego)
    return RenderedFrame(t_s, images, sweep, boxes_at(edited.graph.all_tracks, ego.T_scene_ego, t_s))


def edits_from_arguments(
    tracks: ActorTracks,
    saved: Sequence[Edit],
    shift_left_m: float,
    remove: Sequence[int],
    insert: Sequence[str],
) -> list[Edit]:
    """Return the edits of the command line.

    Args:
        tracks: tracks of the edited run.
        known: edits that come before; inserted actors get ids that these edits do not use.
        shift_left_m: shift of the ego vehicle to the left, m; 0: none.
        remove: ids of actors to remove.
        insert: "RUN:ACTOR@WAY": an actor of another run, on the path of an actor of this run.

    Raises:
        InputError: an entry of `insert` has another format.
    """
    edits: list[Edit] = []
    copies = [edit.copy for edit in saved if isinstance(edit, Duplicate | Insert | DriveStraight)]
    copy = max([*tracks.track_id.tolist(), *copies], default=0) + 1
    for number, text in enumerate(insert):
        source, _, rest = text.rpartition(":")
        actor, _, way = rest.partition("@")
        if not (source and actor.isdecimal() and way.isdecimal()):
            raise InputError(
                f"{text!r}: what is inserted is written RUN:ACTOR@WAY, such as runs/003:17@4: actor 17 of "
                "runs/003 where actor 4 drives here"
            )
        edits.append(Insert(source, int(actor), copy + number, int(way)))
    edits += [Remove(actor) for actor in remove]
    if shift_left_m:
        edits.append(ShiftEgo((0.0, shift_left_m, 0.0)))
    return edits
