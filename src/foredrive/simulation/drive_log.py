"""Writes drives in towns and in rebuilt logs as 123D logs, one frame per observed key frame."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foredrive.data.log_writer import Frame, LogWriter
from foredrive.scene import BicycleState, CameraRig, Trajectory
from foredrive.simulation.carla.simulator import CarlaSimulator
from foredrive.simulation.dynamics import yaw_rate_radps
from foredrive.simulation.observation import KeyFrame
from foredrive.simulation.rebuilt import RebuiltSimulator
from foredrive.simulation.town import TownScenario, TownSimulator
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.recorder import (
    FIRST_TIME_US,
    camera_specs,
    split_of,
    traffic_light_states,
    write_town_map,
)

REBUILT_SPLIT = "rebuilt_test"


def drive_log(scenario: TownScenario, out: Path, name: str) -> LogWriter:
    """Return the writer of a drive's log at out/logs/SPLIT/NAME.

    Without sensors the log has only poses, boxes and traffic lights.
    """
    maps = write_town_map(scenario.town, out)
    cameras = [] if scenario.sensors is None else camera_specs(scenario.sensors.rig)
    split = split_of(scenario.town)
    return LogWriter(out, split, name, cameras, maps, scenario.town, scenario.route_xyz)


def rebuilt_drive_log(
    rig: CameraRig | None, route_xyz: Float64[np.ndarray, "M 3"], out: Path, name: str
) -> LogWriter:
    """Return the writer of the log of a drive in a rebuilt log, at out/logs/SPLIT/NAME.

    Without a rig the log has no images.
    """
    cameras = [] if rig is None else camera_specs(rig)
    return LogWriter(out, REBUILT_SPLIT, name, cameras, None, None, route_xyz)


def key_frame(simulator: TownSimulator, taught: Trajectory | None = None) -> Frame:
    """Return the log frame of a simulator's latest key frame, which must be the current one.

    Args:
        taught: trajectory that the expert would drive from here, a batch of one.
    """
    names = () if simulator.scenario.sensors is None else simulator.scenario.sensors.rig.names
    lights = simulator.traffic.zone_lights(simulator.state.decided.time_s)
    return dataclasses.replace(
        _frame(simulator.state.frames[-1], simulator.state.ego, names),
        taught=None if taught is None else taught[0],
        traffic_lights=traffic_light_states(load_town_map(simulator.scenario.town), lights),
    )


def carla_key_frame(simulator: CarlaSimulator, scenario: TownScenario) -> Frame:
    """Return the log frame of a drive on a CARLA server, as `key_frame` does. Its lights are not logged."""
    names = () if scenario.sensors is None else scenario.sensors.rig.names
    return _frame(simulator.state.frames[-1], simulator.state.ego, names)


def rebuilt_key_frame(simulator: RebuiltSimulator) -> Frame:
    """Return the log frame of a drive in a rebuilt log, as `key_frame` does."""
    names = simulator.renderer.rig.names if simulator.scenario.sensors else ()
    return _frame(simulator.state.frames[-1], simulator.state.ego, names)


def _frame(frame: KeyFrame, ego: BicycleState, names: tuple[str, ...]) -> Frame:
    images = frame.images.permute(0, 2, 3, 1).numpy()
    aside_mps2 = ego.speed_mps * yaw_rate_radps(ego)
    return Frame(
        t_us=FIRST_TIME_US + round(frame.t_s * 1e6),
        T_world_ego=frame.T_world_ego,
        velocity_ego_mps=np.array([frame.speed_mps, 0.0, 0.0]),
        acceleration_ego_mps2=np.array([ego.acceleration_mps2, aside_mps2, 0.0]),
        images=dict(zip(names, images, strict=True)),
        sweep=frame.sweep,
        boxes=frame.boxes,
    )
