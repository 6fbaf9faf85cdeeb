"""`foredrive improve`."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from foredrive.cli.arguments import Settings, SomePaths, check_number, check_out_folder, check_run
from foredrive.cli.drive_options import InReconstruction, InTowns
from foredrive.cli.progress import job_progress
from foredrive.data.log_paths import LogPath, find_all_logs, find_logs
from foredrive.errors import InputError
from foredrive.lazy import importing

if TYPE_CHECKING:
    from foredrive.runs.improve.records import Source

TRAINING, NO_RECONSTRUCTION = InTowns(routes="training-short"), InReconstruction()


def improve(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    pool: SomePaths,
    out: Path,
    towns: tyro.conf.OmitArgPrefixes[InTowns] = TRAINING,
    reconstructed: tyro.conf.OmitArgPrefixes[InReconstruction] = NO_RECONSTRUCTION,
    on: SomePaths = (),
    logs: SomePaths = (),
    judge: Annotated[str | None, tyro.conf.arg(metavar="SET|FILE.xml|LOGS")] = None,
    rounds: int = 3,
    budget: int = 500,
    strategy: Annotated[str, tyro.conf.arg(metavar="NAME")] = "failures-diversity",
    keep_best: bool = False,
    set: Settings = (),
) -> None:
    """Improve a driver, or a detector, by the data that its failures ask for, in rounds.

    A round drives the routes, takes the seconds before each failure as examples, chooses moments of the pool
    that resemble them, trains on these and the run's own logs from the run's weights, and drives again. Each
    round is a folder; an interrupted loop goes on, and --rounds may grow. A world model with a head for
    detection is judged on annotated logs (--on) in place of routes: by the likelihood of its detections.

    Args:
        run: Folder of the run of a driver, or of a world model with a head for detection; or embedded.
        pool: 123D logs, splits or data roots to choose from. Labels are read of the chosen moments alone.
        out: Folder of the loop: a folder for each round, summary.json and report.html.
        on: Annotated logs that are searched for moments in which the detector misses somebody.
        logs: Logs that every round trains on too; by default those that the run was trained on.
        judge: Held-out routes of towns, a set or a file, that judge the rounds; by default the routes of
            --routes, or the drives in the reconstructed log (--in). Neither their towns nor this log may be
            in the pool. For a detector logs, by default those of --on.
        rounds: Number of rounds.
        budget: Moments that are chosen in a round.
        strategy: How: random; uncertainty, where the driver is least sure of what it sees; diversity,
            k-centre over the embeddings; failures, those nearest to the failures, which take turns;
            failures-diversity, k-centre among three times as many of these; anew, from drives on the failed
            routes in other traffic, or against the failed threats earlier, later, faster and beside, in place
            of the pool.
        keep_best: Drop a round that is judged worse than the one before it; the next one starts from the
            better run.
        set: Entries of the run's recipe to replace in the rounds' training. Without any, a driver trains for
            four epochs (emphasis=1, see.epochs=4, see.lr=3e-3), a detector for 100 steps
            (finetune.schedule.steps=100).
    """
    check_out_folder(out)
    towns.check()
    reconstructed.check()
    if towns.carla is not None:
        raise InputError("the loop drives in the embedded towns: leave out --carla")
    check_number("--rounds", rounds, low=1)
    check_number("--budget", budget, low=1)
    folder = check_run(run).absolute()
    pool_logs, own = find_all_logs(pool), find_all_logs(logs) if logs else None

    with importing():
        from rich.console import Console

        from foredrive.runs.improve.loop import Loop
        from foredrive.runs.improve.records import Improvement
        from foredrive.view.improve_report import REPORT, rounds_table, write_improve_report
        from foredrive.view.table import print_table

    source, held_out, trained_on = _sources(run, folder, towns, reconstructed, on, judge)
    improvement = Improvement(
        folder,
        pool_logs,
        trained_on if own is None else own,
        source,
        held_out,
        strategy,
        budget,
        tuple(set),
        keep_best,
        towns.seed,
    )
    loop = Loop(
        improvement,
        out,
        towns.workers or len(os.sched_getaffinity(0)),
        on_ray=towns.ray,
        say=lambda text: print(text, flush=True),
        progress=job_progress,
    )
    result = loop.run(rounds, lambda result, state: write_improve_report(out, result, state))
    print_table(rounds_table(result), Console())
    if result.ended:
        print(f"ended: {result.ended}")
    print(f"run: {result.best.run}")
    print(f"report: {out / REPORT}")


def _sources(
    run: Path,
    folder: Path,
    towns: InTowns,
    reconstructed: InReconstruction,
    on: SomePaths,
    judge: str | None,
) -> "tuple[Source, Source | None, tuple[LogPath, ...]]":
    """Return the source of failures, the one that judges the rounds, and the logs of the run's training."""
    from foredrive.runs.drive.in_towns import TownRoutes
    from foredrive.runs.improve.records import JudgedLogs
    from foredrive.runs.train.driver import is_driver, open_driver
    from foredrive.runs.train.run import open_run

    rebuilt = reconstructed.source()
    usual = dataclasses.replace(TRAINING, seed=towns.seed)  # The seed is that of the choice, too
    if on:
        if rebuilt is not None:
            raise InputError("a detector is judged on logs: --on does not go with --in")
        towns.check_unchanged(usual, "--on")
        held_out = None if judge is None else JudgedLogs(tuple(find_logs(Path(judge))))
        return JudgedLogs(find_all_logs(on)), held_out, open_run(folder).logs
    if not is_driver(folder):
        raise InputError(f"{run}: not the run of a driver; a detector is judged on logs (--on LOGS)")
    if rebuilt is not None:
        # With held-out routes the other options are those of their drives
        given = towns if judge is None else dataclasses.replace(usual, routes=towns.routes, only=towns.only)
        given.check_unchanged(usual, "--in")
    routes = towns.source(str(folder))
    assert isinstance(routes, TownRoutes)
    held_out_routes = None if judge is None else dataclasses.replace(routes, routes=judge, only=())
    return rebuilt or routes, held_out_routes, open_driver(folder).logs
