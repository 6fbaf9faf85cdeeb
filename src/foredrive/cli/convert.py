"""`foredrive convert`."""

from pathlib import Path
from typing import Annotated

import tyro

from foredrive.cli.arguments import check_out_folder
from foredrive.errors import InputError
from foredrive.lazy import importing


def convert(
    dataset: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")],
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Path,
) -> None:
    """Convert a raw data set into 123D logs.

    Args:
        dataset: pandaset, av2, nuscenes-keyframe, kitti-object or kitti-raw; for other data sets use
            py123d-conversion of py123d.
        source: Folder of one raw log, or of many.
        out: 123D data root to write to.
    """
    check_out_folder(out)
    if not source.is_dir():
        raise InputError(f"{source}: no such folder")

    with importing():
        from foredrive.data.convert import convert as convert_logs

    for log in convert_logs(source, dataset, out):
        print(f"wrote {log.folder}")
