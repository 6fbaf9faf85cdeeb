"""`foredrive search`, `search index`, `search page` and `search train`."""

import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from foredrive.cli.arguments import OptionalPath, SomePaths
from foredrive.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from foredrive.recipes.indexing import Indexed
    from foredrive.search.find import Found
    from foredrive.search.index import FrameIndex
    from foredrive.search.query import Query

INDEX, TOWERS = "runs/search", "openai/clip-vit-base-patch32"
FAILURES_SHOWN = 5
Place = Annotated[str, tyro.conf.arg(metavar="PATH|URL")]
Text = Annotated[str | None, tyro.conf.arg(metavar="TEXT")]
Name = Annotated[str | None, tyro.conf.arg(metavar="NAME")]


def search(
    text: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TEXT")] = None,
    index: Place = INDEX,
    like: Annotated[str | None, tyro.conf.arg(metavar="LOG@12.5s")] = None,
    modality: Literal["image", "lidar", "joint"] = "image",
    rule: Literal["features", "logits", "rerank"] = "features",
    image_text: Text = None,
    lidar_text: Text = None,
    where: Annotated[str | None, tyro.conf.arg(metavar="SQL")] = None,
    tagged: Name = None,
    view: str = "any",
    top: int = 20,
    gap: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 5.0,
    diverse: Literal["no", "k-centre", "facility"] = "no",
    by: Annotated[str | None, tyro.conf.arg(metavar="COLUMN")] = None,
    mix: float = 0.5,
    plain: bool = False,
    towers: Name = None,
    out: OptionalPath = None,
    clips: OptionalPath = None,
    before: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 2.0,
    after: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 4.0,
    tag: Name = None,
    untag: Name = None,
    save: Name = None,
    saved: Name = None,
) -> None:
    """Find moments of indexed logs by a text, an example, their facts or their scores.

    `foredrive search index LOGS` makes the index; `foredrive search page` asks it in the browser.

    Args:
        text: What to look for, such as "pedestrian crossing at night".
        index: The index: a folder, or a place on object storage.
        like: Look for what is like a moment (LOG@12.5s), one view of it (LOG@12.5s/VIEW) or a part of that
            (LOG@12.5s/VIEW:LEFT,TOP,RIGHT,BOTTOM in px); LOG is the name of an indexed log or a log's folder.
        modality: Compare with images, with sweeps, or with both.
        rule: How both are joined: the sum of features, the sum of logits, or the best by image ranked again
            by lidar.
        image_text: Compare images with this text instead.
        lidar_text: Compare sweeps with this text instead.
        where: A condition on the index' columns, such as "ego_speed > 5 AND weather = 'rain'"; docs/search.md
            names them.
        tagged: Only moments that have this tag.
        view: any, sectors, all (whole scenes) or the name of a camera.
        top: How many hits.
        gap: Moments of one log that are closer than this are one hit.
        diverse: Of the best ten times as many take those that differ most (k-centre), or that stand for most.
        by: Rank by a column of numbers as well, such as score_missed; without a text by it alone.
        mix: What that column weighs beside likeness, 0 to 1.
        plain: Take texts as they are; else they are worded in several ways.
        towers: Where the towers that made the index lie now, if they have moved.
        out: Write a contact sheet: PNG or HTML.
        clips: Write the hits as a list of clips, which `foredrive train --logs` and other verbs take as logs.
        before: How much of such a clip lies before its hit.
        after: How much of it lies after.
        tag: Give all hits this tag.
        untag: Take this tag away from whatever has it; nothing is looked for.
        save: Keep this query under a name.
        saved: Ask the query that was kept under this name; of the others only --out, --clips and --tag count.
    """
    from foredrive.data.clip_list import write_clip_list
    from foredrive.recipes.searching import ask, listed_clips
    from foredrive.search.index import FrameIndex
    from foredrive.search.kept import add_tag, remove_tag, save_query
    from foredrive.search.query import Query
    from foredrive.view.search_sheet import check_sheet, write_search_sheet

    if out is not None:
        check_sheet(out)
    opened = FrameIndex(index)
    if untag is not None:
        remove_tag(index, untag)
        print(f"nothing is tagged {untag} any more")
        return
    if saved is not None:
        query = _saved(index, saved)
    else:
        query = Query(
            text, image_text, lidar_text, like, modality, rule, where, tagged, view, top, gap,
            None if diverse == "no" else diverse, by, mix,
        )  # fmt: skip
    found = ask(opened, query, towers, ensemble=not plain)
    _tell(opened, found)
    if save is not None:
        save_query(index, save, query.to_json())
    if tag is not None:
        add_tag(index, tag, [str(hit.facts["key"]) for hit in found.hits])
    if not found.hits:
        return
    if clips is not None:
        write_clip_list(clips, listed_clips(found.hits, before, after))
        print(f"wrote {clips}: foredrive train RECIPE --logs {clips}")
    if out is not None:
        write_search_sheet(out, query, found.hits)
        print(f"look: {out}")


def search_index(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOGS [LOGS ...]")],
    index: Place = INDEX,
    towers: Annotated[str, tyro.conf.arg(metavar="NAME|PATH")] = TOWERS,
    stride: Annotated[float, tyro.conf.arg(metavar="SECONDS")] = 0.5,
    workers: int = 0,
    ray: bool = False,
    scores: OptionalPath = None,
) -> None:
    """Index logs for search, or go on with it: what is in stays, what has changed is put in anew.

    Args:
        logs: 123D logs, splits, data roots or lists of clips.
        index: Where the index lies: a folder, or a place on object storage such as s3://bucket/index.
        towers: A CLIP or SigLIP model: its name on Hugging Face's hub, or its folder; or a folder that
            `foredrive search train` made.
        stride: Time between the moments of a log that are indexed.
        workers: How many parts of logs are embedded at a time; 0 is one for each core.
        ray: Embed on Ray: on the cluster at RAY_ADDRESS, or on one started here.
        scores: Per-frame scores of detections, one JSON object a line (docs/search.md); moments that are in
            the index are given them too.
    """
    from foredrive.recipes import find_all_logs
    from foredrive.recipes.indexing import index_logs
    from foredrive.search.scores import read_scores

    found = find_all_logs(logs)
    told = None if scores is None else read_scores(scores)
    with _progress() as tick:
        cores = len(os.sched_getaffinity(0))
        done = index_logs(found, index, towers, stride, workers or cores, on_ray=ray, scores=told, tick=tick)
    _tell_indexed(done, index)


def search_page(index: Place = INDEX, towers: Name = None, host: str = "localhost", port: int = 8090) -> None:
    """Search in the browser: a grid of hits, conditions, a map of all scenes to draw around some.

    Args:
        index: The index: a folder, or a place on object storage.
        towers: Where the towers that made the index lie now, if they have moved.
        host: Where the page is served; other machines see it at 0.0.0.0.
        port: The page's port.
    """
    from foredrive.search.index import FrameIndex
    from foredrive.view.search_page import SearchPage

    page = SearchPage(FrameIndex(index), towers, host, port)
    print(f"{index} is asked at {page.url} until you press Ctrl-C", flush=True)
    try:
        page.serve()
    finally:
        page.close()


def search_train(
    logs: SomePaths,
    out: Path,
    cache: OptionalPath = None,
    beside: Annotated[str | None, tyro.conf.arg(metavar="NAME|PATH")] = None,
    loss: Literal["mse", "cosine"] = "mse",
    image_steps: int | None = None,
    lidar_steps: int | None = None,
    seed: int = 0,
) -> None:
    """Train towers for search, or go on with a run that was interrupted.

    An image tower learns beside a sentence encoder from what is known of each camera's view, then a lidar
    tower from the image tower. Beside CLIP or SigLIP only a lidar tower is trained, from images alone.

    Args:
        logs: 123D logs, splits or data roots with cameras and lidar; image towers need boxes or captions.
        out: Folder of the run; the towers lie in its folder "towers".
        cache: Folder for views; by default "cache" in the run's folder.
        beside: A CLIP or SigLIP model whose images teach the lidar tower.
        loss: What the lidar tower is trained by: mean squared error, or 1 - cosine.
        image_steps: Steps of the image tower; by default 20 epochs.
        lidar_steps: Steps of the lidar tower; by default 10 epochs.
        seed: Of weights and of the order of data.
    """
    from foredrive.recipes import find_all_logs
    from foredrive.recipes.tower_training import embedded_recipe, train_towers

    recipe = embedded_recipe(loss, image_steps, lidar_steps, seed)
    towers = train_towers(recipe, find_all_logs(logs), out, cache, beside)
    print(f"next: foredrive search index LOGS --towers {towers}")


def _saved(index: str, name: str) -> "Query":
    from foredrive.search.kept import saved_queries
    from foredrive.search.query import Query

    kept = saved_queries(index)
    if name not in kept:
        raise InputError(f"{index}: no query is kept as {name}; there are: {', '.join(kept) or 'none'}")
    return Query.from_json(kept[name])


def _tell(index: "FrameIndex", found: "Found") -> None:
    from rich.console import Console

    from foredrive.view.search_sheet import hits_table

    rows = index.count()
    if not found.hits:
        print(f"nothing found among {rows} rows of {index.uri}")
        return
    Console().print(hits_table(found.hits))
    how = "all compared" if found.exact else f"{found.compared} compared, the others passed over by a graph"
    print(f"{len(found.hits)} hits among {rows} rows of {index.uri}; {how}")


def _tell_indexed(done: "Indexed", index: str) -> None:
    print(f"{done.logs} logs are in {index}: {done.rows} new rows, {done.there_before} parts were in already")
    if done.scored:
        print(f"gave {done.scored} rows their scores")
    if done.failed:
        told = [f"{name} ({why})" for name, why in done.failed.items()]
        more = f", and {len(told) - FAILURES_SHOWN} more" if len(told) > FAILURES_SHOWN else ""
        skipped = f"skipped {len(told)} logs: {', '.join(told[:FAILURES_SHOWN])}{more}"
        if not done.logs:
            raise InputError(skipped)
        print(skipped)


@contextmanager
def _progress() -> "Iterator[Callable[[int, int], None]]":
    """A bar over all moments; yields what moves it."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress("embedding moments", *columns) as progress:
        bar = progress.add_task("", total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)
