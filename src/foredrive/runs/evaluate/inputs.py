"""Open the inputs of an evaluation: the clips in batches, and the trained agent as a predictor."""

import dataclasses
import itertools
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.devices import chosen_device
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs.evaluate.predict import AgentPredictor
from foredrive.runs.open_clips import open_clips
from foredrive.runs.train.run import Run, load_agent
from foredrive.runs.train.tasks import TrainedHeads, load_heads
from foredrive.scene import Example
from foredrive.tasks.planning.protocols import STEP_S, STEPS

RENDER_STRIDE = 2
"""One pixel in this many along rows and columns is rendered and compared."""
FUTURES = 5
"""Number of futures drawn from a stochastic world model."""


def evaluation_data(
    run: Run,
    logs: Sequence[LogPath],
    stride_s: float | None = None,
    truth: TaskTruthConfig | None = None,
) -> ClipDataset:
    """Open the clips of `logs` as the recipe defines them, with the boxes for collisions up to 3 s.

    Args:
        stride_s: time between the clips' nows, s; None: as in the recipe.
        truth: truth of further tasks to read.
    """
    clips = run.recipe.clips
    frames = max(clips.future_frames, round(STEPS * STEP_S / clips.frame_dt_s))
    stride_s = stride_s or clips.now_stride_s
    tasks = truth or clips.tasks
    if tasks is not None and tasks.semantics is not None:
        tasks = dataclasses.replace(tasks, rays=True)
    config = dataclasses.replace(
        clips.judged,
        future_frames=frames,
        future_images=False,
        now_stride_s=stride_s,
        tasks=tasks,
    )
    return open_clips(logs, config, run.cache_dir)


def plan_batches(dataset: ClipDataset, batch_size: int) -> list[tuple[int, ...]]:
    """Return the clips of each batch, in order. No batch holds clips of two logs."""
    planned = []
    for _, of_log in itertools.groupby(range(len(dataset)), dataset.log_path):
        clips = tuple(of_log)
        planned += [clips[first : first + batch_size] for first in range(0, len(clips), batch_size)]
    return planned


class Batches(Iterator[Example]):
    """Clips in batches. A clip that cannot be read raises an InputError; the next call continues after it.

    Args:
        planned: the clips of each batch.
    """

    def __init__(self, dataset: ClipDataset, planned: Sequence[Sequence[int]]) -> None:
        self._dataset = dataset
        self._left = deque(deque(clips) for clips in planned)
        self._read: list[Example] = []

    def __next__(self) -> Example:
        while self._left:
            clips = self._left[0]
            while clips:
                self._read.append(self._dataset[clips.popleft()])
            self._left.popleft()
            if self._read:
                batch, self._read = collate(self._read), []
                return batch
        raise StopIteration


@dataclass(frozen=True)
class EvaluationSource:
    """The run and the logs of an evaluation; for several machines, in folders that they share."""

    run: Path
    logs: tuple[LogPath, ...]
    stride_s: float | None = None
    """Time between the clips' nows, s; None: as in the recipe."""
    views: bool = True
    """Render the camera views too."""


@dataclass(frozen=True)
class EvaluationInputs:
    """The clips of an evaluation, and the trained agent as a predictor."""

    source: EvaluationSource
    dataset: ClipDataset
    predictor: AgentPredictor
    heads: TrainedHeads | None
    """The task heads, of the agent or of a probe."""
    device: str
    """The agent's device."""


def open_inputs(run: Run, source: EvaluationSource) -> EvaluationInputs:
    """Load the agent of a run, and open the clips of logs.

    Args:
        run: the run of `source`.

    Raises:
        InputError: the run has not finished a stage, or the logs have no clip.
    """
    agent, heads = load_agent(run), load_heads(run)
    truth = None if heads is None else heads.recipe.truth
    dataset = evaluation_data(run, source.logs, source.stride_s, truth)
    device = chosen_device()
    ray_stride, steps = RENDER_STRIDE if source.views else 0, run.recipe.clips.future_frames
    predictor = agent_predictor(agent.to(device), heads, steps, ray_stride, FUTURES)
    return EvaluationInputs(source, dataset, predictor, heads, device)


def agent_predictor(
    agent: PlanningAgent[Any], trained: TrainedHeads | None, steps: int, ray_stride: int, futures: int = 0
) -> AgentPredictor:
    """Return a predictor with the agent's own heads, or else with those of a probe."""
    heads = agent.heads
    if heads is None and trained is not None:
        heads = trained.heads.to(agent.planner.plan.device)
    return AgentPredictor(agent, steps, ray_stride, futures, heads)
