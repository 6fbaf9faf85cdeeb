"""Agents that can drive a town, by the names that the command line accepts."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import torch

from foredrive.data.resizing import shrink_images
from foredrive.driver.agent import Driver, PartlyTrue, Perception, SightDriver
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.restarts import RestartingAgent, is_free_ahead
from foredrive.driving.simple_agents import StraightAgent
from foredrive.errors import InputError
from foredrive.integrations.remote.json_http import read_address
from foredrive.integrations.remote.planner_client import ALIVE_S, HttpPlanner, check_planner
from foredrive.json_server import Address
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.ego_mlp import EgoMLP
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.driver import is_driver, load_driver, open_driver
from foredrive.runs.train.rigs import TrainedRigs, check_rig, read_rigs
from foredrive.runs.train.run import load_agent, open_run
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.sensors.rigs import SURROUND, RigPlan
from foredrive.tasks.evaluation.frame_keys import MAX_GAP_S
from foredrive.tasks.tracking.following import AgentFollower
from foredrive.towns.driving.demonstrations import AlternatingStudent, DisturbedExpert
from foredrive.towns.driving.idm_agent import IdmAgent, TruePerception
from foredrive.towns.driving.town import TownSimulator
from foredrive.towns.driving.town_expert import TownExpert


@dataclass(frozen=True, eq=False)
class SeeingAgent:
    """The agent of a run. Its images may be smaller than the vehicle records them."""

    agent: PlanningAgent[Any]
    image_hw: tuple[int, int]
    device: str

    def seen(self, observation: Clip) -> Clip:
        """Return the observation as the agent reads it."""
        clip: Clip = shrink_images(observation, self.image_hw).to(self.device)
        return clip

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan."""
        return self.agent.act(self.seen(observation))

    @torch.no_grad()
    def is_free(self, observation: Clip) -> bool:
        """Return whether the world model sees nothing right ahead, for an observation of a batch of one."""
        world = self.agent.world_model
        decoded = world.decode(self.agent.rollout(self.seen(observation), 0)[0])
        return is_free_ahead(decoded.occupancy_logit[0], world.spec)


class FollowingAgent:
    """A `SeeingAgent` in one drive whose planner attends to agents that are carried from frame to frame.

    It is trained with the agents of the frames before, and so it drives with them. They are forgotten after
    a gap in the observations.

    Args:
        seeing: the agent of the run.
        follower: the state of the drive.
        clock: returns the time of the drive, s.
    """

    def __init__(self, seeing: SeeingAgent, follower: AgentFollower, clock: Callable[[], float]) -> None:
        self._seeing, self._follower, self._clock = seeing, follower, clock
        self._before_s: float | None = None

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """Return the plan."""
        agent, clip, now_s = self._seeing.agent, self._seeing.seen(observation), self._clock()
        dt_s = None if self._before_s is None else now_s - self._before_s
        if dt_s is not None and not 0 < dt_s <= MAX_GAP_S:
            dt_s = None
        beliefs = agent.rollout(clip, agent.planner.imagined_frames)
        found, _ = self._follower.step(
            lambda carried: agent.perceived(beliefs[0], carried=carried), clip.T_world_ego[0, clip.now], dt_s
        )
        self._before_s = now_s
        return agent.plan(clip, beliefs, found)


def following(seeing: SeeingAgent, clock: Callable[[], float]) -> Agent:
    """Return the agent for one drive; one with a state if its planner attends to agents that are carried.

    Args:
        seeing: the agent of the run.
        clock: returns the time of the drive, s.
    """
    agent = seeing.agent
    heads = None if agent.heads is None else agent.heads.config.agents
    if agent.planner.scene is None or heads is None or heads.carried is None:
        return seeing
    return FollowingAgent(seeing, AgentFollower(heads.carried), clock)


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
        from foredrive.integrations.remote.alpasim_client import GrpcDriver

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
    if agent.startswith(STUDENT):
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
        from foredrive.integrations.remote.alpasim_client import check_driver

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
        (known for known in (EGO_MLP, STUDENT, IDM_BY_SIGHT, *PARTLY_TRUE) if agent.startswith(known)),
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
