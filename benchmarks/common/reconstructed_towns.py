"""Drives of towns for reconstruction, and the true sensor views of the scene after edits."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw, sensor_twist
from foredrive.methods.reconstruction.edits import Edit, Move, Remove, ShiftEgo
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.vehicle import EgoState
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.scene.actors import ActorState
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import SURROUND, RigPlan, camera_rig
from foredrive.sensors.vehicle import find_lidar
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.recorder import LabelOptions, record, split_of
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import DriveSnapshot, ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import World

FRONT = RigPlan((270, 480), {"PCAM_F0": SURROUND.cameras["PCAM_F0"]})


@dataclass(frozen=True)
class TownDrive:
    """A reproducible drive: as a log, and as the town in which it was recorded."""

    town: str
    seed: int
    seconds: float = 8.0
    rate_hz: float = 10.0
    background_traffic: BackgroundTraffic = dataclasses.field(
        default_factory=lambda: BackgroundTraffic(vehicles=60, pedestrians=20)
    )
    rig: RigPlan = FRONT
    readout_s: float = 0.03
    lidar: str = "pandar64"

    @cached_property
    def sensors(self) -> SensorSuite:
        """Return the sensors of the vehicle."""
        return SensorSuite(camera_rig(None, self.readout_s, self.rig), find_lidar(self.lidar))

    @property
    def frames(self) -> int:
        """Return the number of frames of the log."""
        return max(1, round(self.seconds * self.rate_hz))

    def recorded(self, out: Path) -> LogPath:
        """Return the log in a 123D data root; record it if it is missing. Boxes are its only labels."""
        name = f"{self.town}_seed{self.seed}"
        path = LogPath(out / "logs" / split_of(self.town) / name, out / "maps")
        if path.folder.is_dir():
            return path
        labels = LabelOptions(occupancy=None, visibility=False, captions=False)
        return record(
            self.town,
            self.seconds,
            self.seed,
            out,
            self.rate_hz,
            self.sensors,
            self.background_traffic,
            labels,
            log_name=name,
        )


@dataclass(frozen=True)
class TrueViews:
    """The true views of all sensors at one time."""

    cameras: list[CameraView]
    """Camera views with images."""
    sweep: SweepView


class TownTruth:
    """The town of a drive, seen by its sensors from any pose, with actors moved or removed."""

    def __init__(self, drive: TownDrive) -> None:
        self.drive = drive
        town = load_town_map(drive.town)
        self.world = World(town, drive.seed)
        traffic = Traffic(
            town, drive.seed, drive.background_traffic.vehicles + 1, drive.background_traffic.pedestrians
        )
        moments = ExpertDrive(traffic, drive.seconds).snapshots(drive.frames, 1 / drive.rate_hz)
        self.snapshots: list[DriveSnapshot] = list(moments)

    def seen(self, frame: int, edits: Sequence[Edit] = ()) -> TrueViews:
        """Return the true sensor views at a frame's time after edits, in the frame of the first ego pose.

        Args:
            frame: index of a frame of the log.
            edits: `Move` and `Remove` of actors that are not parked, and `ShiftEgo`.

        Raises:
            InputError: there is another kind of edit.
        """
        moment, sensors = self.snapshots[frame], self.drive.sensors
        actors, T_ego_shifted = _edited(moment.actors, edits)
        T_world_ego = moment.T_world_ego @ T_ego_shifted.numpy()
        twist_ego = sensor_twist(T_ego_shifted, torch.from_numpy(moment.twist_ego))
        picture = self.world.render(
            actors, sensors, T_world_ego, twist_ego.numpy(), noise_seed=frame, lights=moment.lights
        )
        T_world_scene = torch.from_numpy(self.snapshots[0].T_world_ego)
        T_scene_ego = (inverse_se3(T_world_scene) @ torch.from_numpy(T_world_ego)).float()
        seen_from = EgoState(T_scene_ego, twist_ego.float(), moment.t_s)
        cameras = [
            dataclasses.replace(
                novel_camera_view(sensors.rig, number, seen_from),
                image=torch.from_numpy(image).permute(2, 0, 1),
            )
            for number, image in enumerate(picture.images.values())
        ]
        assert picture.sweep is not None
        sweep = SweepView(picture.sweep, True, T_scene_ego, seen_from.twist_ego, moment.t_s)
        return TrueViews(cameras, sweep)


def _edited(
    actors: list[ActorState], edits: Sequence[Edit]
) -> tuple[list[ActorState], Float64[Tensor, "4 4"]]:
    """Return the actors after edits, and the pose of the ego vehicle in its original frame."""
    T_ego_shifted = torch.eye(4, dtype=torch.float64)
    for edit in edits:
        if isinstance(edit, Remove):
            actors = [actor for actor in actors if actor.track_id != edit.actor]
        elif isinstance(edit, Move):
            actors = [_moved(actor, edit) if actor.track_id == edit.actor else actor for actor in actors]
        elif isinstance(edit, ShiftEgo):
            yaw, offset_m = (torch.tensor(x, dtype=torch.float64) for x in (edit.yaw_rad, edit.offset_m))
            T_ego_shifted = T_ego_shifted @ matrix_from_yaw(yaw, offset_m)
        else:
            raise InputError(f"road users of a town can be moved and removed, not: {edit.kind}")
    return actors, T_ego_shifted


def _moved(actor: ActorState, edit: Move) -> ActorState:
    """Move an actor by an offset and a rotation in its own frame; its velocity over the ground stays."""
    cos, sin = np.cos(actor.yaw), np.sin(actor.yaw)
    forward_m, left_m, up_m = edit.offset_m
    shift = np.array([cos * forward_m - sin * left_m, sin * forward_m + cos * left_m, up_m])
    return dataclasses.replace(actor, centre_m=actor.centre_m + shift, yaw=actor.yaw + edit.yaw_rad)
