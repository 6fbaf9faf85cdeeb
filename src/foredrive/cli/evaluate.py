"""`foredrive evaluate`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import (
    OptionalPath,
    SomePaths,
    check_number,
    check_out_folder,
    check_reconstruction,
    check_run,
)
from foredrive.data.log_paths import find_all_logs
from foredrive.lazy import importing


def evaluate(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    logs: SomePaths = (),
    out: OptionalPath = None,
    examples: int = 4,
    batch_size: int = 4,
    write_results: Literal["nuscenes"] | None = None,
    reconstructed: Annotated[OptionalPath, tyro.conf.arg(name="in", metavar="RECONSTRUCTED")] = None,
    workers: int = 1,
    ray: bool = False,
) -> None:
    """Evaluate a trained run and its baselines; write summary.json and report.html.

    With --in it measures the gap between real and rendered images instead, at the held-out times of a
    reconstructed log: how far the run's occupancy and plans agree on both, and how well each fits the labels.

    Args:
        run: Folder of a trained run.
        logs: 123D logs, splits or data roots for the evaluation; by default the training logs, and the report
            then says so.
        out: Folder for summary.json and report.html; by default the folder of the run.
        examples: Number of examples that the report shows in pictures.
        batch_size: Number of clips in a batch.
        write_results: Also write what the task heads predict to the folder "results" beside summary.json, in
            the formats of nuScenes' code bases, which `foredrive score` reads: detection.json, tracking.json,
            motion.json, map.json and the folder occupancy (docs/tasks.md).
        reconstructed: Folder of a reconstruction whose log still exists; writes gap.json.
        workers: Number of processes that predict; 1 predicts in this process, on all cores. On Ray it is the
            size of a cluster that is started here.
        ray: Predict on Ray: on the cluster at RAY_ADDRESS, or on a cluster that is started here.
    """
    check_number("--workers", workers, low=1)
    check_number("--examples", examples, low=0)
    run = check_run(run)
    check_out_folder(out)
    if reconstructed is not None:
        check_reconstruction(reconstructed)
        _evaluate_gap(run, reconstructed, out or run)
        return
    named = find_all_logs(logs)

    with importing():
        from foredrive.engine.folder import held_for_results
        from foredrive.runs import evaluate_run, open_run, predict_examples

    from rich.console import Console

    from foredrive.engine.summary import read_summary
    from foredrive.view.run_report import report_on_run, write_run_report
    from foredrive.view.summary_tables import print_summary

    trained = open_run(run)
    chosen = named or trained.logs
    folder = out or run
    # Metrics, pictures and report appear together; until then they are read back from the scratch folder
    with held_for_results(folder):
        result = evaluate_run(
            trained,
            chosen,
            folder,
            batch_size,
            results_files=write_results is not None,
            workers=workers,
            on_ray=ray,
        )
        summary = read_summary(folder / "summary.json")
        print_summary(summary, Console(), trained.recipe.name)
        predictions = predict_examples(trained, chosen, examples)
        report = report_on_run(trained, chosen, summary, predictions, result.failures)
        write_run_report(folder / "report.html", report)
        print(f"wrote {folder / 'summary.json'} and {folder / 'report.html'}")
    if write_results is not None:
        print(
            f"wrote {folder / 'results'}; next: foredrive score {folder / 'results'}/… --truth LOGS --task …"
        )


def _evaluate_gap(run: Path, reconstructed: Path, out: Path) -> None:
    with importing():
        from rich.console import Console
        from rich.progress import Progress

        from foredrive.engine.folder import held_for_results
        from foredrive.runs import open_run
        from foredrive.runs.evaluate.real_to_sim_gap import GAP, measure_gap
        from foredrive.view.gap_table import gap_table
        from foredrive.view.table import print_table

    with held_for_results(out), Progress() as progress:
        bar = progress.add_task("real and rendered")
        figures = measure_gap(
            open_run(run), reconstructed, out, lambda done, of: progress.update(bar, completed=done, total=of)
        )
    print_table(gap_table(figures), Console())
    print(f"wrote {out / GAP}")
