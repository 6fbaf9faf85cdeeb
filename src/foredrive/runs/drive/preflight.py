"""A trial of an agent of another program before its first drive: two seconds, with checks of all it gets."""

import statistics
import time
from dataclasses import dataclass, field

import torch

from foredrive.data.batches import stack_records
from foredrive.driving.drive import FollowingPilot
from foredrive.driving.dynamics import STEP_S
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.plans import waypoints_of
from foredrive.errors import InputError
from foredrive.runs.drive.agent_inputs import AgentInputs, inputs_of
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.scene import Clip

TRIED_S = 2.0
"""Length of the trial, s of the simulation."""


@dataclass
class Trial:
    """The sensors, plans and times of a trial."""

    shown: str = "nothing"
    """The sensors of the last observation, in words."""
    points: int = 0
    """Number of points of a plan."""
    took_s: list[float] = field(default_factory=list)
    """Time of each plan, s."""

    def text(self, period_s: float) -> str:
        """Return the trial in a sentence or two."""
        first_s, usual_s = self.took_s[0], statistics.median(self.took_s[1:] or self.took_s)
        text = (
            f"tried for {TRIED_S:g} s: it sees {self.shown}, "
            f"and plans {self.points} points in {usual_s:.3g} s (the first in {first_s:.3g} s)"
        )
        slow = usual_s / period_s
        if slow > 1:
            text += f"; that is {slow:.1f} times the planning period, so drives are slower than real time"
        return text


def try_agent(agent: str, setup: DriveSetup, period_s: float, latency_s: float) -> Trial:
    """Let an agent drive the first two seconds of a drive, and check what it gets and answers.

    Args:
        agent: its name.
        setup: the drive.
        period_s: time between plans.
        latency_s: time after which a plan takes effect.

    Raises:
        InputError: a sensor that it declares is missing or has another size, key frames are at other times,
            it fails, or what it answers is not a plan. The message says which, and when.
    """
    inputs, trial, steps = inputs_of(agent), Trial(), round(period_s / STEP_S)
    clip = setup.simulator.reset(setup.scenario)
    setup.log.write(setup.frame())  # a log needs a frame
    pilot = setup.pilot or FollowingPilot(setup.simulator, latency_s)
    for step in range(round(TRIED_S / STEP_S)):
        at_s, ego = step * STEP_S, setup.simulator.ego()
        if step % steps == 0:
            where = f"{agent}, in the trial at {at_s:g} s"
            _check_inputs(clip, inputs, where)
            trial.shown, began = _shown(clip), time.perf_counter()
            try:
                plan = setup.agent.act(stack_records([clip]))
                trial.points = len(waypoints_of(plan))
            except InputError as error:
                raise InputError(f"{where}: {error}") from error
            except Exception as error:  # any error of a foreign agent
                raise InputError(f"{where}: {type(error).__name__}: {error}") from error
            trial.took_s.append(time.perf_counter() - began)
            pilot.expect(plan, ego, at_s)
        moved = pilot.step(ego, at_s)
        clip = moved.clip
        if moved.events:
            break
    return trial


def _check_inputs(clip: Clip, inputs: AgentInputs, where: str) -> None:
    """Check that an observation has what the agent declares."""
    if inputs.cameras and not len(clip.rig.names):
        raise InputError(f"{where}: it needs cameras, and gets none")
    if inputs.cameras and not bool(clip.image_valid[clip.now].any()):
        raise InputError(f"{where}: it needs cameras, and gets no image")
    if inputs.lidar and not bool(clip.sweep_valid[clip.now]):
        raise InputError(f"{where}: it needs the lidar, and gets no sweep")
    steps_s = clip.t_s[1:] - clip.t_s[:-1]
    if len(steps_s) and not torch.allclose(steps_s, torch.tensor(FRAME_DT_S), atol=1e-3):
        raise InputError(f"{where}: key frames are {steps_s.tolist()} s apart, not {FRAME_DT_S} s")


def _shown(clip: Clip) -> str:
    """Return the sensors of an observation in words."""
    parts = []
    if len(clip.rig.names):
        height, width = clip.images.shape[-2:]
        parts.append(f"{', '.join(clip.rig.names)} at {height} x {width} px")
    if bool(clip.sweep_valid[clip.now]):
        sweep = clip.sweeps[clip.now]
        parts.append(f"{int((sweep.valid & sweep.returned).sum())} lidar points")
    frames = f"{len(clip.t_s)} key frames" if len(clip.t_s) > 1 else "a key frame"
    return f"{frames} of {' and '.join(parts) or 'speed, command and route'}"
