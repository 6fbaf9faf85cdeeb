"""Writes drives in towns, in CARLA and in reconstructed logs as 123D logs, one frame per key frame."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from foredrive.data.log_writer import Frame, LogWriter
from foredrive.driving.dynamics import yaw_rate_radps
from foredrive.driving.observation import KeyFrame
from foredrive.scene import BicycleState, CameraRig, Trajectory
from foredrive.towns.driving.town import TownSimulator
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.recorder import (
    FIRST_TIME_US,
    camera_specs,
    lamps_near,
    split_of,
    traffic_light_states,
    write_town_map,
)

RECONSTRUCTED_SPLIT = "reconstructed_test"


def drive_log(
    out: Path,
    name: str,
    route_xyz: Float64[np.ndarray, "M 3"],
    rig: CameraRig | None,
    town: str | None = None,
) -> LogWriter:
    """Return the writer of a drive's log at out/logs/SPLIT/NAME.

    Args:
        rig: cameras of the log. Without them it has no images.
        town: town whose map is written with the log. None for a drive in a reconstructed log.
    """
    maps = None if town is None else write_town_map(town, out)
    split = RECONSTRUCTED_SPLIT if town is None else split_of(town)
    return LogWriter(out, split, name, [] if rig is None else camera_specs(rig), maps, town, route_xyz)


def town_log_frame(simulator: TownSimulator, expert_plan: Trajectory | None = None) -> Frame:
    """Return the log frame of a town's latest key frame, which must be the current one, with its lights.

    Args:
        expert_plan: plan of the expert from here, a batch of one.
    """
    state, sensors = simulator.state, simulator.scenario.sensors
    lights = simulator.traffic.zone_lights(state.decided.time_s)
    town = load_town_map(simulator.scenario.town)
    return dataclasses.replace(
        log_frame(state.frames[-1], state.ego, None if sensors is None else sensors.rig),
        expert_plan=None if expert_plan is None else expert_plan[0],
        traffic_lights=traffic_light_states(town, lights),
        signal_lamps=lamps_near(town, simulator.signal_xyz, state.frames[-1].T_world_ego),
    )


def log_frame(frame: KeyFrame, ego: BicycleState, rig: CameraRig | None) -> Frame:
    """Return the log frame of a key frame.

    Args:
        ego: the ego vehicle at the key frame.
        rig: cameras of the images. None without images.
    """
    images = frame.images.permute(0, 2, 3, 1).numpy()
    # Centripetal acceleration v ω, with the linear acceleration along x
    lateral_mps2 = ego.speed_mps * yaw_rate_radps(ego)
    return Frame(
        t_us=FIRST_TIME_US + round(frame.t_s * 1e6),
        T_world_ego=frame.T_world_ego,
        velocity_ego_mps=np.array([frame.speed_mps, 0.0, 0.0]),
        acceleration_ego_mps2=np.array([ego.acceleration_mps2, lateral_mps2, 0.0]),
        images=dict(zip(() if rig is None else rig.names, images, strict=True)),
        sweep=frame.sweep,
        boxes=frame.boxes,
    )
