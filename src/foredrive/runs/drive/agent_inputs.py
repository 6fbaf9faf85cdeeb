"""The inputs that agents require: sensors, key frames, the cameras of their training."""

import contextlib
from dataclasses import dataclass

from foredrive.driving.observation import FRAME_DT_S
from foredrive.errors import InputError
from foredrive.integrations.own_agents import needs_of
from foredrive.json_http import read_address
from foredrive.methods.reconstruction.vehicle import LoggedVehicle
from foredrive.runs.drive.agents import Sees, agent_folder, find_agent, is_remote
from foredrive.runs.train.driver import is_driver, open_driver
from foredrive.runs.train.rigs import TrainedRigs, check_rig, read_rigs
from foredrive.runs.train.run import open_run
from foredrive.sensors.rigs import DRIVING, NAVSIM, SURROUND, RigPlan, rig_of_cameras


@dataclass(frozen=True)
class AgentInputs:
    """The inputs that an agent requires."""

    cameras: bool
    lidar: bool
    past_frames: int
    camera_names: tuple[str, ...] | None = None
    """Names of the required cameras; None: all cameras."""


def check_seeing(agent: str, sees: Sees | None) -> None:
    """Check that an agent can drive with some sensors alone.

    Raises:
        InputError: it needs others, or has no use for those.
    """
    if sees is not None and agent.startswith("grpc://"):
        raise InputError("drivers of AlpaSim are sent cameras alone: leave out --sees")
    if sees is None or is_remote(agent):
        return
    inputs = inputs_of(agent)
    if (inputs.cameras and sees == "lidar") or (inputs.lidar and sees == "camera"):
        needed = "cameras" if inputs.cameras else "lidar"
        raise InputError(f"{agent} needs its {needed}, which --sees {sees} hides")
    if (not inputs.cameras and sees == "camera") or not (inputs.cameras or inputs.lidar):
        raise InputError(f"{agent} does not look at what --sees {sees} shows")


def inputs_of(agent: str) -> AgentInputs:
    """Return the inputs that an agent requires.

    Args:
        agent: a name of `AGENTS`, with its argument.

    Raises:
        InputError: there is no such agent, or it was trained on another frame interval.
    """
    kind, argument = find_agent(agent)
    if kind.sensors == "remote":
        read_address(agent, kind.name.removesuffix("://"))
        return AgentInputs(cameras=True, lidar=False, past_frames=1)
    if kind.sensors == "declared":
        needs = needs_of(agent)
        names = None if needs.cameras == "all" else needs.cameras
        return AgentInputs(names != (), needs.lidar, needs.past_frames, names)
    if kind.sensors in ("none", "lidar"):
        return AgentInputs(cameras=False, lidar=kind.sensors == "lidar", past_frames=1)
    folder = agent_folder(agent, argument)
    if kind.of_driver and not is_driver(folder):
        raise InputError(f"{folder}: {kind.name}RUN needs the run of a driver, such as driver_small")
    clips = (open_driver(folder) if is_driver(folder) else open_run(folder)).recipe.clips
    if abs(clips.frame_dt_s - FRAME_DT_S) > 1e-6:
        raise InputError(f"{agent}: trained on key frames {clips.frame_dt_s} s apart, not {FRAME_DT_S} s")
    seeing = kind.sensors == "trained"
    return AgentInputs(seeing, lidar=False, past_frames=clips.past_frames, camera_names=clips.cameras)


def rig_of(agent: str) -> RigPlan:
    """Return the rig that most of an agent's training logs have, or that it declares; else the surround rig.

    Raises:
        InputError: it declares a camera that no rig has.
    """
    if find_agent(agent)[0].sensors == "declared":
        return _declared_rig(agent)
    rigs = _rigs_of(agent)
    return SURROUND if rigs is None else rigs.usual


def _declared_rig(agent: str) -> RigPlan:
    """Return the cameras of a town that an agent of a user's class declares, in the size that it declares."""
    needs, usual = needs_of(agent), SURROUND
    if needs.cameras not in ("all", ()):
        pool = NAVSIM.cameras if agent.startswith("navsim:") else {**NAVSIM.cameras, **DRIVING.cameras}
        by_name, chosen = {name.lower(): name for name in pool}, {}
        for declared in needs.cameras:
            if declared.lower() not in by_name:
                raise InputError(f"{agent}: needs the camera {declared}; towns have {', '.join(pool)}")
            name = by_name[declared.lower()]
            chosen[name] = pool[name]
        usual = RigPlan(SURROUND.image_hw, chosen)
    return usual if needs.image_hw is None else usual.of_size(needs.image_hw)


def chosen_cameras(agent: str, vehicle: LoggedVehicle) -> list[int]:
    """Return the cameras of a vehicle that an agent is shown: those that it requires, or else all.

    Of a rig that has more than all cameras of the agent's training, these are chosen.

    Raises:
        InputError: the vehicle lacks a camera that the agent requires.
    """
    if (required := inputs_of(agent).camera_names) is not None:
        return [vehicle.camera(name) for name in required]
    rigs = _rigs_of(agent)
    with contextlib.suppress(InputError):
        if rigs is not None:
            return sorted(vehicle.camera(name) for name in rigs.usual.cameras)
    return list(range(len(vehicle.rig.names)))


def own_rig(agent: str, vehicle: LoggedVehicle) -> RigPlan | None:
    """Return the cameras of an agent's training if a log's differ from them; None if it knows these.

    Only an agent that requires cameras by name has cameras of its own.
    """
    required, rigs = inputs_of(agent).camera_names, _rigs_of(agent)
    if find_agent(agent)[0].sensors == "declared":
        return _declared_cameras(agent, vehicle)
    if required is None or rigs is None or len(required) != len(rigs.usual.cameras):
        return None
    logged, usual = rig_of_cameras(vehicle.rig), rigs.usual
    try:
        shown = {name: logged.cameras[vehicle.rig.names[vehicle.camera(name)]] for name in usual.cameras}
        check_rig(rigs, RigPlan(logged.image_hw, shown), agent)
    except InputError:  # a camera is missing, stands elsewhere or has another field of view
        return RigPlan(usual.image_hw, dict(zip(required, usual.cameras.values(), strict=True)))
    return None


def _declared_cameras(agent: str, vehicle: LoggedVehicle) -> RigPlan | None:
    """Return the cameras that an agent declares, where the log has cameras of its names; None if all fit."""
    needs, logged = needs_of(agent), rig_of_cameras(vehicle.rig)
    if needs.cameras in ("all", ()):
        same = needs.image_hw in (None, logged.image_hw)
        return None if same or needs.image_hw is None else logged.of_size(needs.image_hw)
    places, mounts = _declared_rig(agent).cameras, {}
    for name, usual in zip(needs.cameras, places.values(), strict=True):
        try:
            mounts[name] = logged.cameras[vehicle.rig.names[vehicle.camera(name)]]
        except InputError:
            mounts[name] = usual
    return RigPlan(needs.image_hw or logged.image_hw, mounts)


def check_rig_of(agent: str, rig: RigPlan) -> None:
    """Check that an agent knows a rig.

    Raises:
        InputError: it was not trained with such a rig.
    """
    rigs = _rigs_of(agent)
    if rigs is not None:
        check_rig(rigs, rig, agent)


def _rigs_of(agent: str) -> TrainedRigs | None:
    kind, argument = find_agent(agent)
    has_cameras = kind.sensors == "trained" or kind.of_driver  # a driver that is told all still logs its own
    return read_rigs(agent_folder(agent, argument)) if has_cameras else None
