"""Predict the clips of an evaluation in several processes, or on Ray; batches come back in their order."""

import contextlib
import functools
import itertools
import pickle
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import torch

from foredrive.data import ClipDataset
from foredrive.evaluation.predictor import Part
from foredrive.evaluation.run import Failure, PredictedBatch, predict_batches
from foredrive.runs.evaluate.inputs import Batches, EvaluationInputs, EvaluationSource, open_inputs
from foredrive.runs.fan_out import fan_out, reason
from foredrive.runs.train.run import open_run

SHARD_BATCHES = 4
"""Batches of a shard. The limit keeps the memory independent of the length of a log."""


@dataclass(frozen=True)
class Shard:
    """Consecutive batches that one worker predicts."""

    number: int
    batches: tuple[tuple[int, ...], ...]


def predict_shards(
    inputs: EvaluationInputs,
    planned: Sequence[tuple[int, ...]],
    asked: frozenset[Part],
    workers: int,
    *,
    on_ray: bool = False,
) -> Generator[PredictedBatch, None, None]:
    """Yield the predicted batches in order.

    A shard whose process dies twice counts as failed, clip by clip.

    Args:
        planned: the clips of each batch.
        workers: as in `fan_out`.
    """
    dataset = inputs.dataset
    shards = plan_shards(dataset, planned, inputs.predictor.carries)
    threads = max(1, torch.get_num_threads() // workers)
    work = functools.partial(predict_shard, source=inputs.source, asked=asked, threads=threads)
    waiting, following = dict[int, list[PredictedBatch]](), 0
    with contextlib.closing(fan_out(shards, work, workers, on_ray=on_ray)) as results:
        for shard, result in results:
            if isinstance(result, BaseException):
                why = reason(f"shard {shard.number}", result)
                keys = [dataset.key(clip) for clip in itertools.chain(*shard.batches)]
                waiting[shard.number] = [PredictedBatch(None, (), tuple(Failure(key, why) for key in keys))]
            else:
                waiting[shard.number] = pickle.loads(result)
            while following in waiting:
                yield from waiting.pop(following)
                following += 1


def plan_shards(dataset: ClipDataset, planned: Sequence[tuple[int, ...]], whole_logs: bool) -> list[Shard]:
    """Return shards of a few batches each.

    Args:
        planned: the clips of each batch.
        whole_logs: whether a log is one shard, because a predictor carries something from frame to frame.
    """
    shards = []
    for _, of_log in itertools.groupby(planned, lambda clips: dataset.log_path(clips[0])):
        batches = tuple(of_log)
        size = len(batches) if whole_logs else SHARD_BATCHES
        shards += [batches[first : first + size] for first in range(0, len(batches), size)]
    return [Shard(number, batches) for number, batches in enumerate(shards)]


def predict_shard(shard: Shard, source: EvaluationSource, asked: frozenset[Part], threads: int) -> bytes:
    """Return the predicted batches of a shard, pickled.

    Processes would hand over each tensor by a file descriptor of its own, and run out of them.
    """
    torch.set_num_threads(threads)
    inputs = _opened(source)
    found = predict_batches(inputs.predictor, Batches(inputs.dataset, shard.batches), asked, inputs.device)
    return pickle.dumps([batch.to("cpu") for batch in found])


@functools.lru_cache(maxsize=1)
def _opened(source: EvaluationSource) -> EvaluationInputs:
    """Open the inputs, and keep them for the next shard."""
    return open_inputs(open_run(source.run), source)
