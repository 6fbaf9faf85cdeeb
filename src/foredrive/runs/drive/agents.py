"""Agents that can drive a town, by the names that the command line accepts."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch

from foredrive.driver.agent import Driver, PartlyTrue, Perception, SightDriver
from foredrive.errors import InputError
from foredrive.json_server import Address
from foredrive.models.ego_mlp import EgoMLP
from foredrive.runs.drive.seeing_agents import SeeingAgent, following
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.driver import is_driver, load_driver, open_driver
from foredrive.runs.train.rigs import TrainedRigs, check_rig, read_rigs
from foredrive.runs.train.run import load_agent, open_run
from foredrive.scene import Agent
from foredrive.sensors.rigs import SURROUND, RigPlan
from foredrive.simulation.demonstrations import AlternatingStudent, DisturbedExpert
from foredrive.simulation.idm_agent import IdmAgent, TruePerception
from foredrive.simulation.observation import FRAME_DT_S
from foredrive.simulation.remote.json_http import read_address
from foredrive.simulation.remote.planner_client import ALIVE_S, HttpPlanner, check_planner
from foredrive.simulation.restarts import RestartingAgent
from foredrive.simulation.simple_agents import StraightAgent
from foredrive.simulation.town import TownSimulator
from foredrive.simulation.town_expert import TownExpert

CRUISE_MPS = 5.0
EXPERT, STOP, CONSTANT_VELOCITY, EGO_MLP = "expert", "stop", "constant-velocity", "ego-mlp:"
REPLAY = "log"
"""The agent that repeats the logged drive (log replay)."""
CORRIDOR = "lidar-corridor"
"""The agent that follows the logged path and stops if lidar sees something in its corridor."""
OF_LOGS = (REPLAY, CORRIDOR)
"""Agents that need the path of a log; `in_rebuilt` makes them, and another expert."""
HTTP = "http://"
"""Beginning of the address of a planner behind neuro-ncap's model server protocol."""
GRPC = "grpc://"
"""Beginning of the address of a driver behind AlpaSim's contract."""
DISTURBED, STUDENT = "disturbed", "student:"
IDM, IDM_BY_SIGHT = "idm", "idm:"
PARTLY_TRUE = {"true:": (True, True), "true-lights:": (True, False), "true-users:": (False, True)}
"""Prefixes of a driver's run that drives with lights, and with road users, as they truly are."""
OLD_STUDENT = "pupil:"
"""The prefix of `STUDENT` in earlier versions, still accepted."""


@dataclass(frozen=True)
class AgentInputs:
    """The inputs that an agent requires."""

    cameras: bool
    lidar: bool
    past_frames: int
    camera_names: tuple[str, ...] | None = None
    """Names of the required cameras; None: all cameras."""


Sees = Literal["camera", "lidar", "both"]
"""Sensors that an agent is shown."""


def check_seeing(agent: str, sees: Sees | None) -> None:
    """Check that an agent can drive with some sensors alone.

    Raises:
        InputError: it needs others, or has no use for those.
    """
    if sees is not None and agent.startswith(GRPC):
        raise InputError("drivers of AlpaSim are sent cameras alone: leave out --sees")
    if sees is None or is_remote(agent):
        return
    inputs = inputs_of(agent)
    if (inputs.cameras and sees == "lidar") or (agent == CORRIDOR and sees == "camera"):
        needed = "cameras" if inputs.cameras else "lidar"
        raise InputError(f"{agent} needs its {needed}, which --sees {sees} hides")
    if (not inputs.cameras and sees == "camera") or not (inputs.cameras or inputs.lidar):
        raise InputError(f"{agent} does not look at what --sees {sees} shows")


def inputs_of(agent: str) -> AgentInputs:
    """Return the inputs that an agent requires.

    Args:
        agent: "expert", "stop", "constant-velocity", a run folder, or "ego-mlp:RUN": the MLP that sees only
            the ego status, fitted to the training data of the run. For DAgger demonstrations: "disturbed",
            the expert under disturbances, or "student:RUN", a run that drives in alternation with the expert.
            "log" and "lidar-corridor" follow the path of a reconstructed log.
            "http://HOST:PORT" is a planner in another process (`HttpPlanner`), "grpc://HOST:PORT" a driver of
            AlpaSim (`GrpcDriver`).
            "idm" follows the route by the intelligent driver model and knows lights and road users;
            "idm:RUN" knows of them what a driver's run sees. "true:RUN", "true-lights:RUN" and
            "true-users:RUN" are a driver to whom both, the lights, or the road users are told as they are.

    Raises:
        InputError: there is no such agent, or it was trained on another frame interval.
    """
    if is_remote(agent):
        _address_of(agent)
        return AgentInputs(cameras=True, lidar=False, past_frames=1)
    if agent in (EXPERT, STOP, CONSTANT_VELOCITY, DISTURBED, IDM, *OF_LOGS):
        return AgentInputs(cameras=False, lidar=agent == CORRIDOR, past_frames=1)
    folder = _run_folder(agent)
    clips = (open_driver(folder) if is_driver(folder) else open_run(folder)).recipe.clips
    if abs(clips.frame_dt_s - FRAME_DT_S) > 1e-6:
        raise InputError(f"{agent}: trained on key frames {clips.frame_dt_s} s apart, not {FRAME_DT_S} s")
    seeing = not agent.startswith((EGO_MLP, "true:"))
    return AgentInputs(seeing, lidar=False, past_frames=clips.past_frames, camera_names=clips.cameras)


def rig_of(agent: str) -> RigPlan:
    """Return the rig that most of an agent's training logs have; the surround rig if the agent has none."""
    rigs = _rigs_of(agent)
    return SURROUND if rigs is None else rigs.usual


def check_rig_of(agent: str, rig: RigPlan) -> None:
    """Check that an agent knows a rig.

    Raises:
        InputError: it was not trained with such a rig.
    """
    rigs = _rigs_of(agent)
    if rigs is not None:
        check_rig(rigs, rig, agent)


def _rigs_of(agent: str) -> TrainedRigs | None:
    if agent in (EXPERT, STOP, CONSTANT_VELOCITY, DISTURBED, IDM, *OF_LOGS) or agent.startswith(
        (EGO_MLP, HTTP, GRPC)
    ):
        return None
    return read_rigs(_run_folder(agent))


def make_agent(
    agent: str,
    clock: Callable[[], float],
    town: TownSimulator | None = None,
    seed: int = 0,
    sees: Sees | None = None,
) -> Agent:
    """Create the agent of one drive.

    Args:
        agent: as for `inputs_of`.
        clock: returns the time of the drive, s.
        town: the town that the expert drives in; the other agents do not need it.
        seed: seed of the random disturbances and turns in a demonstration.
        sees: what an agent in another process is sent; None: cameras.

    Raises:
        InputError: there is no such agent, or it needs the expert and there is no town.
    """
    if agent == EXPERT:
        return _expert(town)
    if agent == DISTURBED:
        return DisturbedExpert(_expert(town), clock, seed)
    if agent in (STOP, CONSTANT_VELOCITY):
        return StraightAgent(CRUISE_MPS if agent == CONSTANT_VELOCITY else 0.0)
    if agent in OF_LOGS:
        raise InputError(
            f"the agent {agent} follows the path of a log and can drive only in a reconstruction"
        )
    if agent.startswith(GRPC):
        require_alpasim()
        from foredrive.simulation.remote.alpasim_client import GrpcDriver

        return GrpcDriver(_address_of(agent), clock)
    if agent.startswith(HTTP):
        return HttpPlanner(
            _address_of(agent), clock, cameras=sees != "lidar", lidar=sees in ("lidar", "both")
        )
    if agent == IDM:
        return IdmAgent(_town(town))
    folder = _run_folder(agent)
    if agent.startswith(IDM_BY_SIGHT):
        if not is_driver(folder):
            raise InputError(f"{folder}: {IDM_BY_SIGHT}RUN needs the run of a driver, such as driver_small")
        return IdmAgent(_town(town), Perception(_driver(folder)))
    for prefix, (lights, users) in PARTLY_TRUE.items():
        if agent.startswith(prefix):
            driver, truth = _driver(folder), TruePerception(_town(town))
            return SightDriver(driver, PartlyTrue(Perception(driver), truth, lights=lights, users=users))
    if agent.startswith(EGO_MLP):
        return RestartingAgent(_fitted(folder), clock)
    if agent.startswith((STUDENT, OLD_STUDENT)):
        driven = SightDriver(_driver(folder)) if is_driver(folder) else following(_seeing(folder), clock)
        return AlternatingStudent(driven, _expert(town), clock, seed)
    if is_driver(folder):
        return SightDriver(_driver(folder))
    return RestartingAgent(following(_seeing(folder), clock), clock, _seeing(folder).is_free)


def is_remote(agent: str) -> bool:
    """Return whether an agent is in another process. It remembers the frames that it was sent."""
    return agent.startswith((HTTP, GRPC))


def _address_of(agent: str) -> Address:
    """Return the address of an agent in another process."""
    return read_address(agent, "grpc" if agent.startswith(GRPC) else "http")


def require_alpasim() -> None:
    """Check that AlpaSim's contract is installed.

    Raises:
        InputError: it is not.
    """
    if importlib.util.find_spec("carla_driver_interface") is None:
        raise InputError("AlpaSim's driver contract is missing: pip install 'foredrive[alpasim]'")


def check_ready(agent: str) -> None:
    """Wait until an agent in another process is alive.

    Raises:
        InputError: it is not.
    """
    if agent.startswith(GRPC):
        require_alpasim()
        from foredrive.simulation.remote.alpasim_client import check_driver

        check_driver(_address_of(agent), ALIVE_S)
    elif is_remote(agent):
        check_planner(_address_of(agent))


def _expert(town: TownSimulator | None) -> TownExpert:
    return TownExpert(_town(town))


def _town(town: TownSimulator | None) -> TownSimulator:
    if town is None:
        raise InputError("the expert and idm read the state of an embedded town and can drive only there")
    return town


def _run_folder(agent: str) -> Path:
    prefix = next(
        (
            known
            for known in (EGO_MLP, STUDENT, OLD_STUDENT, IDM_BY_SIGHT, *PARTLY_TRUE)
            if agent.startswith(known)
        ),
        "",
    )
    folder = run_folder(Path(agent.removeprefix(prefix)))
    if not folder.is_dir():
        partly_true = ", ".join(f"{truth}RUN" for truth in PARTLY_TRUE)
        known = (
            f"{EXPERT}, {STOP}, {CONSTANT_VELOCITY}, a run folder, {EGO_MLP}RUN, {HTTP}HOST:PORT, "
            f"{GRPC}HOST:PORT, {IDM}, {IDM_BY_SIGHT}RUN, {partly_true}, "
            f"{DISTURBED} or {STUDENT}RUN, and in a reconstruction {REPLAY} or {CORRIDOR}"
        )
        raise InputError(f"unknown agent {agent!r}; the agents are {known}")
    return folder


@lru_cache(maxsize=1)  # a worker drives many routes with the same agent
def _seeing(folder: Path) -> SeeingAgent:
    run, device = open_run(folder), "cuda" if torch.cuda.is_available() else "cpu"
    return SeeingAgent(load_agent(run).to(device), run.recipe.clips.image_hw, device)


@lru_cache(maxsize=1)
def _driver(folder: Path) -> Driver:
    return load_driver(open_driver(folder))


@lru_cache(maxsize=1)
def _fitted(folder: Path) -> EgoMLP:
    run = open_run(folder)
    planner, clips = run.recipe.planner, run.recipe.clips
    past_frames = clips.past_frames if planner.ego_mlp is None else planner.history
    return run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, past_frames)[1]
