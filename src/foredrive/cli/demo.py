"""`foredrive demo`."""

import time
from pathlib import Path

from foredrive.cli.arguments import OptionalPath, check_out_folder
from foredrive.cli.progress import duration, job_progress, progress_lines
from foredrive.errors import InputError
from foredrive.lazy import importing


def demo(out: OptionalPath = None, quick: bool = False) -> None:
    """Go once round the loop: record towns, see, learn, drive, reconstruct, search, improve; in one report.

    Args:
        out: Folder for logs, runs and report.html; by default runs/demo or runs/demo-quick. An interrupted
            demo continues where it stopped.
        quick: Use very little data and training. This shows in about a minute that everything works.
    """
    check_out_folder(out)

    with importing():
        from foredrive.engine.provenance import collect_provenance
        from foredrive.runs.demo import Demo, full_demo, quick_demo
        from foredrive.view.demo_report import do_steps, write_demo_report
        from foredrive.view.demo_steps import STEPS
        from foredrive.view.html import Provenance

    started = began = time.perf_counter()
    size = quick_demo() if quick else full_demo()
    folder = out or Path("runs", "demo-quick" if quick else "demo")
    step = "demo"

    # The step that runs, and when it began, are read by the thread of `progress_lines`
    def tell(text: str) -> None:
        nonlocal step, began
        step, began = text, time.perf_counter()
        print(text, flush=True)

    total = f"{sum(size.seconds.values()) / 60:.0f} minutes" if size.seconds else "a minute"
    print(f"{len(STEPS)} steps, about {total} of computing", flush=True)
    with progress_lines(lambda: f"still {step}: {duration(time.perf_counter() - began)}; in all"):
        outcomes = do_steps(STEPS, Demo(size, folder, job_progress), tell)
    report = folder / "report.html"
    write_demo_report(report, outcomes, Provenance.of(collect_provenance()))
    print(f"done in {time.perf_counter() - started:.0f} s: the report is {report}")
    failed = [outcome.step.title for outcome in outcomes if outcome.failure]
    if failed:
        raise InputError(f"{len(failed)} of {len(outcomes)} steps failed: {', '.join(failed)} ({report})")
