"""`foredrive evaluate`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, SomePaths


def evaluate(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    logs: SomePaths = (),
    out: OptionalPath = None,
    examples: int = 4,
    batch_size: int = 4,
) -> None:
    """Judge a trained run against its baselines; write summary.json and report.html.

    Args:
        run: Folder of a trained run.
        logs: 123D logs, splits or data roots to judge it on; by default those it was trained on, which the
            report then says.
        out: Folder for summary.json and report.html; the run's own by default.
        examples: How many examples the report shows in pictures.
        batch_size: Clips judged at once.
    """
    from rich.console import Console

    from foredrive.evaluation import print_summary, read_summary
    from foredrive.recipes import evaluate_run, find_all_logs, inspect_run, open_run
    from foredrive.view.report import write_report
    from foredrive.view.run_report import report_on_run

    trained = open_run(run)
    chosen = find_all_logs(logs) if logs else trained.logs
    folder = out or run
    result = evaluate_run(trained, chosen, folder, batch_size)
    summary = read_summary(folder / "summary.json")
    print_summary(summary, Console(), trained.recipe.name)
    inspections = inspect_run(trained, chosen, examples)
    report = report_on_run(trained, chosen, summary, inspections, result.failures)
    write_report(folder / "report.html", report)
    print(f"wrote {folder / 'summary.json'} and {folder / 'report.html'}")
