"""Recording of a drive of the expert in a town as a 123D log with exact labels."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int
from py123d.api.map.arrow.arrow_id_utils import ToIntMapping
from py123d.datatypes import TrafficLightStatus
from rich.progress import track
from torch import Tensor

from foredrive.data.log_paths import LogPath
from foredrive.data.log_writer import CameraSpec, Frame, LogWriter
from foredrive.data.maps import write_map
from foredrive.errors import InputError
from foredrive.ops.threads import prefetched
from foredrive.scene import CameraRig, VoxelSpec
from foredrive.scene.actors import ActorState, boxes_in_ego_frame, in_box_range
from foredrive.scene.conditions import BackgroundTraffic, Conditions
from foredrive.scene.traffic_light import LightState
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.labels.captions import caption
from foredrive.towns.labels.frame_facts import FactCollector
from foredrive.towns.labels.semantics import (
    TrackCategories,
    camera_labels,
    instance_labels,
    lidar_labels,
    z_depth,
)
from foredrive.towns.labels.visibility import is_point_visible
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.map_objects import map_objects
from foredrive.towns.map.names import is_held_out, map_name
from foredrive.towns.map.town_map import TownMap
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.traffic.expert import DriveSnapshot, ExpertDrive
from foredrive.towns.traffic.traffic import Traffic
from foredrive.towns.world import SensorFrame, World

FIRST_TIME_US = 1_577_836_800_000_000
"""Midnight of 1 January 2020 UTC. The time in a log must not depend on when it was recorded."""
OCCUPANCY = VoxelSpec(lower_m=(-50.0, -50.0, -3.0), voxel_m=0.5, shape_zyx=(16, 200, 200))
"""Grid of NeMo."""
MAX_RATE_HZ = 100.0
STATUS_OF_LIGHT = {
    LightState.RED: TrafficLightStatus.RED,
    LightState.YELLOW: TrafficLightStatus.YELLOW,
    LightState.GREEN: TrafficLightStatus.GREEN,
}


@dataclass(frozen=True)
class LabelOptions:
    """The exact labels of a recording, in addition to boxes with their lidar points, and traffic lights."""

    occupancy: VoxelSpec | None = OCCUPANCY
    """Grid of the occupancy with flow, including hidden voxels; None for no occupancy."""
    visibility: bool = True
    """Share of each box that the cameras see."""
    depth: bool = False
    """Depth images."""
    semantic: bool = False
    """Semantic images, and a label for each lidar return."""
    instance: bool = False
    """Track ids as images and for each lidar return."""
    captions: bool = True
    """Captions, with the facts from which they are composed (`Setting`)."""


LAMPS_M = 90.0
"""Distance up to which the lamps of traffic lights are recorded, m."""


def split_of(town: str) -> str:
    """Return the 123D split of a town's recordings."""
    return "town_test" if is_held_out(town) else "town_train"


def record(
    town: str,
    seconds: float,
    seed: int,
    out: Path,
    rate_hz: float = 10.0,
    sensors: SensorSuite | None = None,
    background_traffic: BackgroundTraffic | None = None,
    labels: LabelOptions | None = None,
    conditions: Conditions | None = None,
    log_name: str | None = None,
) -> LogPath:
    """Record one drive. The same arguments give the same bytes on the same kind of processor.

    The log is written to out/logs/SPLIT/NAME and replaces a log of that name. The map is written to out/maps,
    once for all logs of the town. There are boxes for all road users within `BOX_RANGE_M`, parked cars
    included. The number of lidar returns from each one, and its visible share, distinguish hidden from
    visible ones.

    Args:
        town: one of `TOWNS`, a tile, or the path of an OpenDRIVE file.
        seconds: duration of the drive, s.
        seed: seed of the buildings, the route, the traffic and all noise.
        out: 123D data root.
        rate_hz: frames per second.
        sensors: by default six cameras of 144 × 256 px and a lidar of 32 × 720 beams.
        background_traffic: `BackgroundTraffic()` by default.
        labels: `LabelOptions()` by default.
        conditions: time of day and weather. None draws bright daylight from the seed.
        log_name: TOWN_seedN by default.

    Raises:
        InputError: there is no such town, or no frame to record.
        OSError: the disk is full. The incomplete log is removed.
    """
    if not seconds > 0:
        raise InputError(f"the length of a recording must be more than 0 s, got {seconds:g}")
    if not 0 < rate_hz <= MAX_RATE_HZ:
        raise InputError(f"the frame rate must be above 0 and at most {MAX_RATE_HZ:g} Hz, got {rate_hz:g}")
    if seed < 0:
        raise InputError(f"the seed must be at least 0, got {seed}")
    town_map = load_town_map(town)
    sensors = sensors or SensorSuite(camera_rig((144, 256)), roof_lidar())
    background_traffic = background_traffic or BackgroundTraffic()
    labels = labels or LabelOptions()
    # World, traffic and route follow from town and seed
    world = World(town_map, seed, conditions)
    traffic = Traffic(town_map, seed, background_traffic.vehicles + 1, background_traffic.pedestrians)
    drive = ExpertDrive(traffic, seconds)
    maps = write_town_map(town, out)
    name, count = log_name or f"{map_name(town)}_seed{seed}", max(1, round(seconds * rate_hz))
    collector = FactCollector(town_map, traffic.lanes, drive.route, world.conditions, world.signal_xyz)
    # The next frame is rendered while the labels of the present one are computed
    sensed = prefetched(_sense(world, drive.snapshots(count, 1 / rate_hz), sensors, seed))
    route = drive.route.polyline(traffic.lanes)
    with LogWriter(
        out, split_of(town), name, camera_specs(sensors.rig), maps, map_name(town), route
    ) as writer:
        for snapshot in track(sensed, description=f"recording {name}", total=count):
            writer.write(_frame(world, snapshot, sensors, labels, collector))
    return LogPath(writer.folder, maps)


def write_town_map(town: str, out: Path) -> Path:
    """Write the town's map, once for all of its logs, and return the folder of the maps."""
    return write_map(map_objects(town), map_name(town), out)


def traffic_light_states(town: TownMap, lights: Int[np.ndarray, "Z"]) -> dict[int, TrafficLightStatus]:
    """Return the states of the lights by the ids that the lanes behind them have in the written map.

    Args:
        town: the map.
        lights: a `LightState` for each of the town's stop zones.
    """
    # The map's writer numbers lanes in the order of the parser, which is their order in the town.
    id_of = ToIntMapping.from_list([lane.lane_id for lane in town.lanes]).str_to_int
    return {
        id_of[lane]: STATUS_OF_LIGHT[LightState(light)]
        for zone, light in zip(town.stop_zones, lights.tolist(), strict=True)
        if light != LightState.NONE
        for lane in zone.lane_ids
    }


def lamps_near(
    town: TownMap,
    signal_xyz: Mapping[int, Float64[np.ndarray, "_ 3"]],
    T_world_ego: Float64[np.ndarray, "4 4"],
) -> dict[int, Float64[np.ndarray, "_ 3"]]:
    """Return the lamps within `LAMPS_M` of the vehicle by the ids of the lanes that they guard.

    Args:
        town: the map.
        signal_xyz: points on the lamps of each light by the index of its stop zone.
        T_world_ego: pose of the vehicle.
    """
    id_of = ToIntMapping.from_list([lane.lane_id for lane in town.lanes]).str_to_int
    lamps = dict[int, Float64[np.ndarray, "_ 3"]]()
    for zone, xyz in signal_xyz.items():
        near = xyz[np.linalg.norm(xyz - T_world_ego[:3, 3], axis=1) < LAMPS_M]
        if len(near):
            lamps |= {id_of[lane]: near for lane in town.stop_zones[zone].lane_ids if lane in id_of}
    return lamps


class SensedFrame(NamedTuple):
    """A moment of a drive with its sensor data."""

    snapshot: DriveSnapshot
    frame: SensorFrame
    seed: int
    """Seed of the random parts of the frame."""


def _sense(
    world: World, snapshots: Iterator[DriveSnapshot], sensors: SensorSuite, seed: int
) -> Iterator[SensedFrame]:
    for index, snapshot in enumerate(snapshots):
        frame = world.render(
            snapshot.actors,
            sensors,
            snapshot.T_world_ego,
            snapshot.twist_ego,
            # Noise from seed and frame number: frames could be rendered in any order
            noise_seed=np.random.SeedSequence((seed, index)).generate_state(1)[0].item(),
            lights=snapshot.lights,
        )
        yield SensedFrame(snapshot, frame, seed + index)


def _frame(
    world: World, sensed: SensedFrame, sensors: SensorSuite, labels: LabelOptions, collector: FactCollector
) -> Frame:
    """Return all recorded data of a moment."""
    snapshot, frame, seed = sensed
    actors = [*snapshot.actors, *world.parked]
    near = in_box_range(actors, snapshot.T_world_ego)
    # Track ids of the beams that returned, to count the lidar points of each box
    returned = None if frame.sweep is None else frame.beam_ids[frame.sweep.returned.numpy()]
    boxes = boxes_in_ego_frame(near, snapshot.T_world_ego)
    visibility, setting, text = None, None, None
    # Captions need the visibility too, also if it is not recorded
    if labels.visibility or labels.captions:
        visibility = world.visibility(near, sensors, snapshot.T_world_ego, frame)
        if labels.captions:
            range_m = np.stack(list(frame.pixel_range_m.values()))
            facts = collector.facts(
                snapshot, near, visibility, lambda xyz: is_point_visible(xyz, sensors.rig, range_m)
            )
            setting, text = facts.setting, caption(facts, seed)
    spec = labels.occupancy
    return Frame(
        t_us=FIRST_TIME_US + round(snapshot.t_s * 1e6),
        T_world_ego=snapshot.T_world_ego,
        velocity_ego_mps=snapshot.twist_ego[:3],
        acceleration_ego_mps2=snapshot.acceleration_ego_mps2,
        images=frame.images,
        sweep=frame.sweep,
        boxes=boxes if returned is None else replace(boxes, num_points=_count(near, returned)),
        occupancy=None if spec is None else world.occupancy(snapshot.actors, snapshot.T_world_ego, spec),
        visibility=visibility if labels.visibility else None,
        setting=setting,
        caption=text,
        traffic_lights=traffic_light_states(world.town, snapshot.lights),
        signal_lamps=lamps_near(world.town, world.signal_xyz, snapshot.T_world_ego),
        **_ray_labels(frame, actors, sensors, labels),
    )


def _ray_labels(
    frame: SensorFrame, actors: list[ActorState], sensors: SensorSuite, labels: LabelOptions
) -> dict[str, Any]:
    """Return the labels of pixels and beams by their names in `Frame`."""
    out: dict[str, Any] = {}
    names = list(frame.images)
    if labels.depth:
        range_m = np.stack(list(frame.pixel_range_m.values()))
        out["depth_m"] = dict(zip(names, z_depth(range_m, sensors.pixel_rays[1], sensors.rig), strict=True))
    if labels.semantic:
        categories = TrackCategories(actors)
        out["semantic"] = {
            name: camera_labels(frame.pixel_surface[name], categories[frame.pixel_ids[name]])
            for name in names
        }
        if frame.sweep is not None:
            out["beam_semantic"] = lidar_labels(frame.beam_surface, categories[frame.beam_ids])
    if labels.instance:
        out["instance"] = {name: instance_labels(frame.pixel_ids[name]) for name in names}
        if frame.sweep is not None:
            out["beam_instance"] = instance_labels(frame.beam_ids)
    return out


def _count(actors: list[ActorState], hit_ids: Int[np.ndarray, "N"]) -> Int[Tensor, "M"]:
    """Return how often each actor was hit."""
    hit, count = np.unique(hit_ids, return_counts=True)
    counts = dict(zip(hit.tolist(), count.tolist(), strict=True))
    return torch.tensor([counts.get(actor.track_id, 0) for actor in actors], dtype=torch.int64)


def camera_specs(rig: CameraRig) -> list[CameraSpec]:
    """Return the cameras of a rig as declared in a log."""
    return [
        CameraSpec(
            name,
            rig.K[i].numpy(),
            rig.T_ego_cam[i].numpy(),
            rig.size_hw,
            float(rig.readout_s[i]),
            rig.dist[i].numpy() if rig.dist[i].any() else None,
        )
        for i, name in enumerate(rig.names)
    ]
