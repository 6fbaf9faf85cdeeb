"""`foredrive export ncore`."""

import importlib.util
from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_out_folder, whole_logs
from foredrive.cli.failures import listed_failures
from foredrive.cli.progress import frame_progress
from foredrive.errors import InputError
from foredrive.lazy import importing


def export_ncore(
    logs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG [LOG ...]")],
    out: Path,
    overwrite: bool = False,
) -> None:
    """Write logs as sequences in NVIDIA's NCore v4 format, the format of NuRec, 3DGRUT and AlpaSim's scenes.

    A sequence has the images, calibrations, sweeps with their misses, poses and boxes of a log. Exported logs
    are kept, so an interrupted export continues where it stopped. A log that cannot be read does not stop the
    others.

    Args:
        logs: Logs, splits or data roots.
        out: Folder; a log becomes OUT/SPLIT/NAME/NAME.json and the stores beside it.
        overwrite: Export logs again that were exported before.
    """
    if importlib.util.find_spec("ncore") is None:
        raise InputError("NCore needs the package nvidia-ncore: pip install 'foredrive[ncore]'")
    check_out_folder(out)
    log_paths = whole_logs("export ncore", logs)

    with importing():
        from foredrive.data.logs import Log
        from foredrive.files import atomic_path
        from foredrive.integrations.ncore import write_ncore

    failed: dict[str, str] = {}
    with frame_progress("exporting") as tick:
        for path in log_paths:
            folder = out / path.name
            if folder.is_dir() and not overwrite:
                print(f"kept {folder} (was there; --overwrite exports it again)", flush=True)
                continue
            try:
                with atomic_path(folder) as temporary:
                    temporary.mkdir()
                    write_ncore(Log(path), temporary, tick)
            except InputError as error:
                failed[path.name] = str(error)
            else:
                print(f"wrote {folder}", flush=True)
    if failed and len(log_paths) == 1:
        raise InputError(next(iter(failed.values())))
    if failed:
        raise InputError(f"{len(failed)} of {len(log_paths)} logs failed: {listed_failures(failed)}")
