"""Argoverse 2 sensor logs from their public bucket."""

import re
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from foredrive.data.raw.s3_files import S3Object, download, list_folders, list_objects
from foredrive.errors import InputError

BUCKET = "https://argoverse.s3.amazonaws.com"
ROOT = "datasets/av2/sensor"
SPLITS = ("train", "val", "test")
_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


@dataclass(frozen=True)
class RemoteLog:
    """The files of one log in the bucket."""

    log_id: str
    split: str
    files: Sequence[S3Object]

    @property
    def size(self) -> int:
        """Return the size of all files, bytes."""
        return sum(file.size for file in self.files)

    def path(self, file: S3Object) -> PurePosixPath:
        """Return where a file goes: SPLIT/ID/…"""
        return PurePosixPath(file.key).relative_to(ROOT)


def find_log(
    log_id: str, bucket: str = BUCKET, *, seconds: float | None = None, images: bool = True
) -> RemoteLog:
    """List the files of a log.

    Args:
        log_id: its name, a UUID.
        bucket: address of the bucket.
        seconds: if given, images and sweeps of the first seconds alone.
        images: whether images are wanted.

    Raises:
        InputError: the name is none, no split has the log, or a key leads out of its folder.
    """
    if not _ID.fullmatch(log_id):
        raise InputError(
            f"{log_id!r} is not the name of an Argoverse 2 log, such as 00a6ffc1-6ce9-3bc3-a060-6006e9893a1a"
        )
    for split in SPLITS:
        prefix = f"{ROOT}/{split}/{log_id}/"
        files = [file for file in list_objects(bucket, prefix) if not file.key.endswith("/")]
        if files:
            for file in files:
                if not file.key.startswith(prefix) or ".." in PurePosixPath(file.key).parts or file.size < 0:
                    raise InputError(f"{bucket}: the key {file.key!r} is not in the folder of {log_id}")
            return RemoteLog(log_id, split, _wanted(files, seconds, images))
    raise InputError(f"{bucket}/{ROOT}: no log {log_id} in {', '.join(SPLITS)}")


def log_ids(split: str, bucket: str = BUCKET) -> list[str]:
    """Return the names of the logs of a split."""
    return sorted(name for name in list_folders(bucket, f"{ROOT}/{split}/") if _ID.fullmatch(name))


def fetch_log(
    log: RemoteLog, out: Path, at_a_time: int, tick: Callable[[int], None], bucket: str = BUCKET
) -> Path:
    """Download the files of a log, and return its folder: out/SPLIT/ID.

    Args:
        log: the files.
        out: folder of the data set.
        at_a_time: number of files downloaded at a time.
        tick: called with the number of bytes that came, from several threads.
        bucket: address of the bucket.

    Raises:
        InputError: the disk has too little space, or a file cannot be had or is damaged.
    """
    missing = sum(file.size for file in log.files if not (out / log.path(file)).is_file())
    out.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out).free
    if missing > free:
        raise InputError(
            f"{out}: {missing / 1e9:.2f} GB are missing, but the disk has {free / 1e9:.2f} GB left"
        )
    pool = ThreadPoolExecutor(at_a_time)
    try:
        for _ in pool.map(lambda file: download(bucket, file, out / log.path(file), tick), log.files):
            pass
    finally:
        pool.shutdown(cancel_futures=True)
    return out / log.split / log.log_id


def _wanted(files: Sequence[S3Object], seconds: float | None, images: bool) -> list[S3Object]:
    """Return the files of images and sweeps that are wanted, and all others."""
    timed = {file: int(stem) for file in files if (stem := PurePosixPath(file.key).stem).isdecimal()}
    sweeps = [t_ns for file, t_ns in timed.items() if "/sensors/lidar/" in file.key]
    end_ns = min(sweeps or timed.values(), default=0) + (seconds or 0.0) * 1e9
    return [
        file
        for file in files
        if (images or "/sensors/cameras/" not in file.key)
        and (seconds is None or file not in timed or timed[file] <= end_ns)
    ]
