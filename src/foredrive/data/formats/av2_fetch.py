"""Download Argoverse 2 sensor logs from their public S3 bucket, over plain HTTPS and without credentials.

Downloads resume. The listing is S3's ListObjectsV2. The ETag of an object is its MD5 unless it was uploaded
in parts (AWS, "Amazon S3 API Reference", Object).
"""

import contextlib
import hashlib
import http.client
import os
import re
import shutil
import time
import urllib.error
import urllib.parse
import urllib.request
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from foredrive.errors import InputError

MAX_LISTING_BYTES = 2**24
"""Largest page of a listing: 1000 objects take 300 kB."""
TRIES, TIMEOUT_S, CHUNK_BYTES = 4, 30.0, 2**20
_MD5_DIGITS = 32
_NETWORK = (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError)


@dataclass(frozen=True)
class S3Object:
    """One object of a bucket."""

    key: str
    size: int
    etag: str

    @property
    def md5(self) -> str | None:
        """Return the MD5 of its content, or None if the ETag is another sum."""
        return self.etag if len(self.etag) == _MD5_DIGITS and "-" not in self.etag else None


def list_objects(bucket: str, prefix: str) -> Iterator[S3Object]:
    """Yield all objects whose keys begin with a prefix.

    Args:
        bucket: address of the bucket, such as https://argoverse.s3.amazonaws.com.
        prefix: begin of the keys.

    Raises:
        InputError: the bucket cannot be reached, or does not answer with a listing.
    """
    for page in _pages(bucket, {"prefix": prefix}):
        for entry in page.iterfind("{*}Contents"):
            try:
                size = int(_text(entry, "Size"))
            except ValueError as error:
                raise InputError(f"{bucket}: an object without a size in its listing") from error
            yield S3Object(_text(entry, "Key"), size, _text(entry, "ETag").strip('"').lower())


def list_folders(bucket: str, prefix: str) -> Iterator[str]:
    """Yield the names of the "folders" right below a prefix that ends in a slash."""
    for page in _pages(bucket, {"prefix": prefix, "delimiter": "/"}):
        for entry in page.iterfind("{*}CommonPrefixes"):
            yield _text(entry, "Prefix").removeprefix(prefix).rstrip("/")


def _pages(bucket: str, query: dict[str, str]) -> Iterator[ET.Element]:
    token: str | None = None
    seen: set[str] = set()
    # S3 lists 1000 objects a page; a token continues the listing
    while True:
        asked = {"list-type": "2", **query} | ({"continuation-token": token} if token else {})
        url = f"{bucket}/?{urllib.parse.urlencode(asked)}"
        with _opened(url, {}) as answer:
            content = answer.read(MAX_LISTING_BYTES + 1)
        if len(content) > MAX_LISTING_BYTES:
            raise InputError(f"{bucket}: its listing has more than {MAX_LISTING_BYTES} bytes")
        try:
            page = ET.fromstring(content)
        except ET.ParseError as error:
            raise InputError(f"{bucket}: it does not answer with a listing of S3: {error}") from error
        yield page
        token = _text(page, "NextContinuationToken")
        if _text(page, "IsTruncated") != "true" or not token:
            return
        # A repeated token would never end
        if token in seen:
            raise InputError(f"{bucket}: its listing does not end")
        seen.add(token)


def _text(entry: ET.Element, name: str) -> str:
    child = entry.find(f"{{*}}{name}")
    return "" if child is None or child.text is None else child.text


def download(
    bucket: str, entry: S3Object, file: Path, tick: Callable[[int], None], pause_s: float = 1.0
) -> None:
    """Download an object, from where an earlier download of it stopped, and check its size and MD5.

    The file has its name only when it is complete; before, it ends in ".part". A file of the right size is
    kept.

    Args:
        bucket: address of the bucket.
        entry: the object.
        file: where it goes.
        tick: called with the number of bytes that came, which may be negative when a download starts anew.
        pause_s: time before the second try; it doubles with each.

    Raises:
        InputError: it cannot be had within `TRIES` tries, or its content is not what the listing says.
    """
    if file.is_file() and file.stat().st_size == entry.size:
        tick(entry.size)
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(file.name + ".part")
    tick(min(part.stat().st_size, entry.size) if part.is_file() else 0)
    for attempt in range(TRIES):
        try:
            _continue(f"{bucket}/{urllib.parse.quote(entry.key)}", entry, part, tick)
            break
        except InputError:
            raise
        except _NETWORK as error:
            if attempt + 1 == TRIES:
                raise InputError(
                    f"{bucket}/{entry.key}: {_reason(error)} ({TRIES} tries); start again to go on"
                ) from error
            time.sleep(pause_s * 2**attempt)
    os.replace(part, file)


def _continue(url: str, entry: S3Object, part: Path, tick: Callable[[int], None]) -> None:
    """Download what is missing of `part`, and check it."""
    # What an interrupted download left behind
    have = part.stat().st_size if part.is_file() else 0
    if have > entry.size:
        part.unlink()
        have = 0
    if have < entry.size or not part.is_file():
        # If-Range sends the rest only if the object is the same as before
        headers = {"Range": f"bytes={have}-", "If-Range": f'"{entry.etag}"'} if have else {}
        with _opened(url, headers) as answer:
            if have and answer.status != http.client.PARTIAL_CONTENT:  # it has changed, or knows no ranges
                tick(-have)
                have = 0
            with part.open("ab" if have else "wb") as file:
                while chunk := answer.read(CHUNK_BYTES):
                    have += len(chunk)
                    if have > entry.size:
                        raise InputError(f"{url}: it has more than the {entry.size} bytes of the listing")
                    file.write(chunk)
                    tick(len(chunk))
        if have < entry.size:
            raise ConnectionError(f"it ended after {have} of {entry.size} bytes")
    # An ETag of another form is no MD5 and cannot be checked
    if entry.md5 is not None and _md5(part) != entry.md5:
        part.unlink()
        raise InputError(
            f"{url}: its content is not what the listing says (MD5); start again to fetch it anew"
        )


@contextlib.contextmanager
def _opened(url: str, headers: dict[str, str]) -> Iterator[Any]:
    try:
        with urllib.request.urlopen(
            urllib.request.Request(url, headers=headers), timeout=TIMEOUT_S
        ) as answer:
            yield answer
    except urllib.error.HTTPError as error:
        # Errors of the server may pass and are tried again; others are final
        if error.code >= 500:
            raise ConnectionError(f"error {error.code}") from error
        raise InputError(f"{url}: error {error.code} {error.reason}") from error
    except ValueError as error:
        raise InputError(f"{url}: not an address: {error}") from error


def _md5(file: Path) -> str:
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()


def _reason(error: BaseException) -> str:
    reason = getattr(error, "reason", None) or error
    return " ".join(str(reason).split()) or type(error).__name__


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
                # Keys become paths: nothing may lead out of the log's folder
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
    # Check the free space before the first byte
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
    # Names of images and sweeps are their times in ns
    timed = {file: int(stem) for file in files if (stem := PurePosixPath(file.key).stem).isdecimal()}
    sweeps = [t_ns for file, t_ns in timed.items() if "/sensors/lidar/" in file.key]
    # Seconds count from the first sweep
    end_ns = min(sweeps or timed.values(), default=0) + (seconds or 0.0) * 1e9
    return [
        file
        for file in files
        if (images or "/sensors/cameras/" not in file.key)
        and (seconds is None or file not in timed or timed[file] <= end_ns)
    ]
