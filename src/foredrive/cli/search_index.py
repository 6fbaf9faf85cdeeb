"""`foredrive search index` and `search train`."""

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, SomePaths, check_file, check_number, check_out_folder
from foredrive.cli.failures import listed_failures
from foredrive.cli.search import INDEX
from foredrive.cli.search_options import Place, Seconds
from foredrive.data.log_paths import find_all_logs
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from foredrive.runs.search.indexing import Indexed

TOWERS = "embedded"
FAILURES_SHOWN = 5


def search_index(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOGS [LOGS ...]")],
    index: Place = INDEX,
    towers: Annotated[str, tyro.conf.arg(metavar="NAME|PATH")] = TOWERS,
    stride: Seconds = 0.5,
    workers: int = 0,
    ray: bool = False,
    scores: OptionalPath = None,
) -> None:
    """Index logs for search, or continue: indexed logs stay, changed logs are indexed again.

    Args:
        logs: 123D logs, splits, data roots or lists of clips.
        index: Location of the index: a folder, or object storage such as s3://bucket/index.
        towers: "embedded", the towers of this package; or a CLIP or SigLIP model: its name on the Hugging
            Face hub, or its folder; or a folder that `foredrive search train` made.
        stride: Time between the moments of a log that are indexed, s.
        workers: Number of parts of logs embedded at a time; 0: one for each core.
        ray: Embed on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
        scores: Per-frame scores of detections, one JSON object per line (docs/search.md); moments that are
            already in the index receive them too.
    """
    check_number("--stride", stride, above=0)
    check_number("--workers", workers, low=0)
    check_file(scores)
    log_paths = find_all_logs(logs)

    with importing():
        from foredrive.runs.search.indexing import index_logs
        from foredrive.search.scores import read_scores

    log_scores = None if scores is None else read_scores(scores)
    with _progress() as tick:
        cores = len(os.sched_getaffinity(0))
        done = index_logs(
            log_paths, index, towers, stride, workers or cores, on_ray=ray, scores=log_scores, tick=tick
        )
    _print_indexed(done, index)


def search_train(
    logs: SomePaths,
    out: Path,
    cache: OptionalPath = None,
    beside: Annotated[str | None, tyro.conf.arg(metavar="NAME|PATH")] = None,
    size: Literal["tiny", "base"] | None = None,
    loss: Literal["mse", "cosine"] = "mse",
    image_steps: int | None = None,
    lidar_steps: int | None = None,
    seed: int = 0,
) -> None:
    """Train towers for search, or continue an interrupted run.

    An image tower is trained with a sentence encoder on the known facts of each camera's view, then a lidar
    tower on the image tower. With --beside only a lidar tower is trained, on the images alone.

    Args:
        logs: 123D logs, splits or data roots with cameras and lidar; image towers need boxes or captions.
        out: Folder of the run; the towers are in its folder "towers".
        cache: Folder for views; by default "cache" in the run's folder.
        beside: Towers whose image embeddings train the lidar tower: embedded, a folder, or a CLIP or SigLIP
            model.
        size: Lidar tower: tiny, like the shipped one, for CPUs; or base, that of LidarCLIP with its
            schedule, for a GPU. By default base beside other towers than the shipped ones, and else tiny.
        loss: Loss of the lidar tower: mean squared error, or 1 - cosine.
        image_steps: Training steps of the image tower; by default 20 epochs.
        lidar_steps: Training steps of the lidar tower; by default 10 epochs (tiny) or 1 (base).
        seed: Seed of the weights and of the order of the data.
    """
    check_number("--image-steps", image_steps, low=1)
    check_number("--lidar-steps", lidar_steps, low=1)
    check_number("--seed", seed, low=0)
    check_out_folder(out)
    log_paths = find_all_logs(logs)

    with importing():
        from foredrive.runs.search.tower_training import tower_recipe, train_towers

    size = size or ("tiny" if beside in (None, TOWERS) else "base")
    recipe = tower_recipe(size, loss, image_steps, lidar_steps, seed)
    towers = train_towers(recipe, log_paths, out, cache, beside)
    print(f"next: foredrive search index LOGS --towers {towers}")


def _print_indexed(done: "Indexed", index: str) -> None:
    print(f"{done.logs} logs are in {index}: {done.rows} new rows, {done.there_before} parts were there")
    if done.scored:
        print(f"set the scores of {done.scored} rows")
    if done.failed:
        skipped = f"skipped {len(done.failed)} logs: {listed_failures(done.failed, FAILURES_SHOWN)}"
        if not done.logs:
            raise InputError(skipped)
        print(skipped)


@contextmanager
def _progress() -> "Iterator[Callable[[int, int], None]]":
    """Show a progress bar over all moments; yield the function that updates it."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress("embedding moments", *columns) as progress:
        bar = progress.add_task("", total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)
