"""`foredrive demo`."""

import time
from pathlib import Path

from foredrive.cli.arguments import OptionalPath, check_out_folder
from foredrive.cli.progress import progress_lines
from foredrive.errors import InputError
from foredrive.lazy import importing


def demo(out: OptionalPath = None, quick: bool = False) -> None:
    """Go once round the loop: record towns, see, learn, drive, rebuild, search; one report shows it all.

    Args:
        out: Folder for logs, runs and report.html; by default runs/demo or runs/demo-quick. An interrupted
            demo continues where it stopped.
        quick: Use very little data and training. This shows in about a minute that everything works.
    """
    check_out_folder(out)

    with importing():
        from foredrive.evaluation.provenance import collect_provenance
        from foredrive.runs.demo import Demo, full_demo, quick_demo
        from foredrive.view.demo_report import do_steps, write_demo_report
        from foredrive.view.demo_steps import STEPS
        from foredrive.view.html import Provenance

    started = time.perf_counter()
    folder = out or Path("runs", "demo-quick" if quick else "demo")
    step = "demo"

    def tell(text: str) -> None:
        nonlocal step
        step = text
        print(text, flush=True)

    with progress_lines(lambda: f"still {step}"):
        outcomes = do_steps(STEPS, Demo(quick_demo() if quick else full_demo(), folder), tell)
    report = folder / "report.html"
    write_demo_report(report, outcomes, Provenance.of(collect_provenance()))
    print(f"done in {time.perf_counter() - started:.0f} s: the report is {report}")
    failed = [outcome.step.title for outcome in outcomes if outcome.failure]
    if failed:
        raise InputError(f"{len(failed)} of {len(outcomes)} steps failed: {', '.join(failed)} ({report})")
