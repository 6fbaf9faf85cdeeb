"""`foredrive fetch av2`."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import tyro

from foredrive.cli.arguments import check_number, check_out_folder
from foredrive.lazy import importing

SHOWN = 20


def fetch_av2(
    log: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ID [ID ...]")] = (),
    out: Path = Path("av2"),
    seconds: float | None = None,
    images: bool = True,
    at_a_time: int = 4,
    dry_run: bool = False,
    split: Literal["train", "val", "test"] = "val",
    bucket: str = "https://argoverse.s3.amazonaws.com",
) -> None:
    """Fetch Argoverse 2 sensor logs from their public bucket, without credentials.

    The size is printed first. An interrupted download continues where it stopped. Sizes and checksums are
    checked. Argoverse 2 is published under CC BY-NC-SA 4.0. Without --log, names of some logs are printed.

    Args:
        log: Names of logs.
        out: Folder of the data set; a log goes to OUT/SPLIT/ID.
        seconds: Fetch only the images and sweeps of the first seconds.
        images: Fetch the images, which are most of a log.
        at_a_time: Number of files that are downloaded at a time.
        dry_run: Print the sizes and fetch nothing.
        split: Split whose logs are printed without --log; a log is found in any.
        bucket: Address of the bucket, or of a copy of it.
    """
    check_number("--seconds", seconds, above=0)
    check_number("--at-a-time", at_a_time, low=1, high=32)
    check_out_folder(out)
    with importing():
        from foredrive.data.formats.av2_fetch import fetch_log, find_log, log_ids

    bucket = bucket.rstrip("/")
    if not log:
        ids = log_ids(split, bucket)
        print("\n".join(ids[:SHOWN]))
        print(f"{min(SHOWN, len(ids))} of the {len(ids)} logs of {split}; fetch some by --log ID")
        return
    wanted = [find_log(log_id, bucket, seconds=seconds, images=images) for log_id in log]
    for entry in wanted:
        print(f"{entry.log_id} ({entry.split}): {len(entry.files)} files, {_size(entry.size)}", flush=True)
    if dry_run:
        return
    with _progress(sum(entry.size for entry in wanted)) as tick:
        folders = [fetch_log(entry, out, at_a_time, tick, bucket) for entry in wanted]
    for folder in folders:
        print(f"fetched {folder}")
    print(f"next: foredrive convert av2 {folders[0]} --out data")


def _size(size: int) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


@contextmanager
def _progress(total: int) -> Iterator[Callable[[int], None]]:
    """Show the number of downloaded bytes; yield the function that adds to it."""
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn

    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        bar = progress.add_task("", total=total)
        yield lambda size: progress.advance(bar, size)
