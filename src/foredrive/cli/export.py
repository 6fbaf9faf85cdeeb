"""`foredrive export`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import OptionalPath, SomePaths, check_number, check_out_folder, check_run
from foredrive.data.log_paths import find_all_logs
from foredrive.lazy import importing


def export(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    out: OptionalPath = None,
    logs: SomePaths = (),
    clips: int = 8,
) -> None:
    """Write a trained run as model.onnx and model.pt2 (torch.export); compare both with the run itself.

    Args:
        run: Folder of a trained run.
        out: Folder for the models and export.json, which describes inputs, outputs, differences and
            latencies; by default "export" in the run's folder.
        logs: 123D logs, splits or data roots for the comparison; by default the training logs.
        clips: Number of clips to compare.
    """
    run = check_run(run)
    check_number("--clips", clips, low=1)
    check_out_folder(out)
    named = find_all_logs(logs)

    with importing():
        from foredrive.engine.folder import held_for_results
        from foredrive.runs import open_run
        from foredrive.runs.export import export_run

    trained = open_run(run)
    folder = out or run / "export"
    with held_for_results(folder):
        facts = export_run(trained, named or trained.logs, folder, clips)
    for name, latency in facts["latency_ms"].items():
        print(f"{name}: {latency['median']:.1f} ms a clip (90 % below {latency['p90']:.1f} ms)")
        for output, difference in facts["largest_difference"].get(name, {}).items():
            print(f"    {output}: maximum difference {difference:.2g}")
    print(f"wrote {folder / 'model.onnx'}, {folder / 'model.pt2'} and {folder / 'export.json'}")
