"""Drives in towns as 123D logs, like those that `record` writes, at the key frames that the agent saw."""

from pathlib import Path

import numpy as np

from foredrive.data.log_writer import Frame, LogWriter
from foredrive.scene import Trajectory
from foredrive.simulation.dynamics import yaw_rate_radps
from foredrive.simulation.town import TownScenario, TownSimulator
from foredrive.towns.map.town_map import load_town_map
from foredrive.towns.recorder import (
    FIRST_TIME_US,
    camera_specs,
    lights_of_lanes,
    split_of,
    write_town_map,
)


def drive_log(scenario: TownScenario, out: Path, name: str) -> LogWriter:
    """The writer of a drive's log, at out/logs/SPLIT/NAME; without sensors it has poses, boxes and lights."""
    maps = write_town_map(scenario.town, out)
    cameras = [] if scenario.sensors is None else camera_specs(scenario.sensors.rig)
    split = split_of(scenario.town)
    return LogWriter(out, split, name, cameras, maps, scenario.town, scenario.route_xyz)


def key_frame(simulator: TownSimulator, taught: Trajectory | None = None) -> Frame:
    """What is logged of a simulator's latest key frame, if that is now.

    Args:
        taught: what a teacher would do from here, a batch of one.
    """
    frame, ego = simulator.state.frames[-1], simulator.state.ego
    names = () if simulator.scenario.sensors is None else simulator.scenario.sensors.rig.names
    images = frame.images.permute(0, 2, 3, 1).numpy()
    aside_mps2 = ego.speed_mps * yaw_rate_radps(ego)
    lights = simulator.traffic.zone_lights(simulator.state.decided.time_s)
    return Frame(
        t_us=FIRST_TIME_US + round(frame.t_s * 1e6),
        T_world_ego=frame.T_world_ego,
        velocity_ego_mps=np.array([frame.speed_mps, 0.0, 0.0]),
        acceleration_ego_mps2=np.array([ego.acceleration_mps2, aside_mps2, 0.0]),
        images=dict(zip(names, images, strict=True)),
        sweep=frame.sweep,
        boxes=frame.boxes,
        taught=None if taught is None else taught[0],
        traffic_lights=lights_of_lanes(load_town_map(simulator.scenario.town), lights),
    )
