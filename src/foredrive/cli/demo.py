"""`foredrive demo`."""

import time
from pathlib import Path

from foredrive.cli.arguments import OptionalPath, check_out_folder
from foredrive.lazy import importing

EXAMPLES, QUICK_EXAMPLES = 4, 1


def demo(out: OptionalPath = None, quick: bool = False) -> None:
    """Run the whole loop: record towns, train NeMo on them, evaluate it in a town that it has not seen.

    Args:
        out: Folder for logs, run and report; by default runs/demo or runs/demo-quick. An interrupted demo
            continues where it stopped.
        quick: Use very little data and training. This shows in about a minute that everything works.
    """
    check_out_folder(out)

    with importing():
        from rich.console import Console

        from foredrive.evaluation.summary import read_summary
        from foredrive.runs import full_demo, predict_examples, quick_demo, run_demo
        from foredrive.view.overview import write_overview
        from foredrive.view.run_report import report_on_run, write_run_report
        from foredrive.view.summary_tables import print_summary

    started = time.perf_counter()
    folder = out or Path("runs", "demo-quick" if quick else "demo")
    run, logs = run_demo(quick_demo() if quick else full_demo(), folder, print)
    summary = read_summary(run.folder / "summary.json")
    print_summary(summary, Console(), run.recipe.name)
    print("4/4 drawing the report")
    examples = predict_examples(run, logs, QUICK_EXAMPLES if quick else EXAMPLES)
    report = run.folder / "report.html"
    write_run_report(report, report_on_run(run, logs, summary, examples))
    fastest = max(examples, key=lambda shown: float(shown.example.clip.ego_speed_mps.amax()))
    write_overview(run.folder / "hero.png", fastest)  # its plan is long enough to be seen
    print(f"done in {time.perf_counter() - started:.0f} s: the report is {report}")
