"""Agents of runs as they drive: images in the size of training, other vehicles followed over time."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from foredrive.data.resizing import shrink_images
from foredrive.devices import chosen_device
from foredrive.driver.agent import Driver
from foredrive.driving.restarts import is_free_ahead
from foredrive.heads.following import AgentFollower
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.ego_mlp import EgoMLP
from foredrive.runs.train.baselines import run_baselines
from foredrive.runs.train.driver import load_driver, open_driver
from foredrive.runs.train.run import load_agent, open_run
from foredrive.scene import Agent, Clip, Trajectory
from foredrive.tasks.files.frame_keys import MAX_GAP_S


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
        output, _ = self._follower.step(
            lambda carried: agent.perceived(beliefs[0], carried=carried), clip.T_world_ego[0, clip.now], dt_s
        )
        self._before_s = now_s
        return agent.plan(clip, beliefs, output)


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


@lru_cache(maxsize=1)  # a worker drives many routes with the same agent
def seeing_agent(folder: Path) -> SeeingAgent:
    """Return the agent of a run."""
    run, device = open_run(folder), chosen_device()
    return SeeingAgent(load_agent(run).to(device), run.recipe.clips.image_hw, device)


@lru_cache(maxsize=1)
def driver_of(folder: Path) -> Driver:
    """Return the driver of a run. Its eyes are on the GPU if there is one; its planner is small."""
    driver = load_driver(open_driver(folder))
    driver.eyes.to(chosen_device())
    return driver


@lru_cache(maxsize=1)
def fitted_mlp(folder: Path) -> EgoMLP:
    """Return the MLP of the ego status, fitted to the training data of a run."""
    run = open_run(folder)
    planner, clips = run.recipe.planner, run.recipe.clips
    past_frames = clips.past_frames if planner.ego_mlp is None else planner.history
    return run_baselines(run.folder, run.logs, run.recipe, run.cache_dir, past_frames)[1]
