"""Download Argoverse 2 sensor logs from their public S3 bucket, over plain HTTPS and without credentials.

Downloads resume. The listing is S3's ListObjectsV2. The ETag of an object is its MD5 unless it was uploaded
in parts (AWS, "Amazon S3 API Reference", Object). Tried with a server of the tests, never with the bucket
itself (`docs/how-to/other-tools.md`).
"""

import hashlib
import http.client
import io
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

from foredrive.errors import InputError

BUCKET = "https://argoverse.s3.amazonaws.com"
ROOT = "datasets/av2/sensor"
SPLITS = ("train", "val", "test")
MAX_LISTING_BYTES = 2**24
"""Largest page of a listing: 1000 objects take 300 kB."""
TRIES, PAUSE_S, TIMEOUT_S, CHUNK_BYTES = 4, 1.0, 30.0, 2**20
"""`PAUSE_S` passes before the second try; it doubles with each."""
_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_MD5 = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class S3Object:
    """One object of a bucket."""

    key: str
    size: int
    etag: str


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
        InputError: the name is none, no split has the log, a key leads out of its folder, or the bucket
            cannot be reached or does not answer with a listing.
    """
    if not _ID.fullmatch(log_id):
        raise InputError(
            f"{log_id!r} is not the name of an Argoverse 2 log, such as 00a6ffc1-6ce9-3bc3-a060-6006e9893a1a"
        )
    for split in SPLITS:
        prefix, files = f"{ROOT}/{split}/{log_id}/", list[S3Object]()
        for entry in _entries("Contents", bucket, prefix=prefix):
            key, size = _text(entry, "Key"), _text(entry, "Size")
            if not size.isascii() or not size.isdecimal():
                raise InputError(f"{bucket}: an object without a size in its listing")
            # Keys become paths: nothing may lead out of the log's folder
            if not key.startswith(prefix) or ".." in PurePosixPath(key).parts:
                raise InputError(f"{bucket}: the key {key!r} is not in the folder of {log_id}")
            if not key.endswith("/"):
                files.append(S3Object(key, int(size), _text(entry, "ETag").strip('"').lower()))
        if files:
            return RemoteLog(log_id, split, _wanted(files, seconds, images))
    raise InputError(f"{bucket}/{ROOT}: no log {log_id} in {', '.join(SPLITS)}")


def log_ids(split: str, bucket: str = BUCKET) -> list[str]:
    """Return the names of the logs of a split."""
    folders = _entries("CommonPrefixes", bucket, prefix=f"{ROOT}/{split}/", delimiter="/")
    names = [PurePosixPath(_text(entry, "Prefix")).name for entry in folders]
    return sorted(filter(_ID.fullmatch, names))


def fetch_log(
    log: RemoteLog, out: Path, at_a_time: int, tick: Callable[[int], None], bucket: str = BUCKET
) -> Path:
    """Download the files of a log, and return its folder: out/SPLIT/ID.

    A download goes on where an earlier one stopped. Until a file is complete, its name ends in ".part".

    Args:
        log: the files.
        out: folder of the data set.
        at_a_time: number of files downloaded at a time.
        tick: called with the number of bytes that came, from several threads. It may be negative: a download
            starts anew.
        bucket: address of the bucket.

    Raises:
        InputError: the disk has too little space, or a file cannot be had or is damaged.
    """
    paths = {file: out / PurePosixPath(file.key).relative_to(ROOT) for file in log.files}
    # Check the free space before the first byte
    missing = sum(file.size for file, path in paths.items() if not path.is_file())
    out.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(out).free
    if missing > free:
        raise InputError(
            f"{out}: {missing / 1e9:.2f} GB are missing, but the disk has {free / 1e9:.2f} GB left"
        )

    pool = ThreadPoolExecutor(at_a_time)
    try:
        for _ in pool.map(lambda file: _download(bucket, file, paths[file], tick), log.files):
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


def _entries(kind: str, bucket: str, **query: str) -> Iterator[ET.Element]:
    """Yield the entries of a listing of the bucket."""
    tokens = list[str]()
    # S3 lists 1000 objects a page; a token continues the listing. A repeated token would never end
    while len(set(tokens)) == len(tokens):
        after = {"continuation-token": tokens[-1]} if tokens else {}
        content = io.BytesIO()
        query_text = urllib.parse.urlencode({"list-type": "2", **query, **after})
        _receive(f"{bucket}/?{query_text}", content)
        try:
            page = ET.fromstring(content.getvalue())
        except ET.ParseError as error:
            raise InputError(f"{bucket}: it does not answer with a listing of S3: {error}") from error
        yield from page.iterfind(f"{{*}}{kind}")
        if _text(page, "IsTruncated") != "true" or not _text(page, "NextContinuationToken"):
            return
        tokens.append(_text(page, "NextContinuationToken"))
    raise InputError(f"{bucket}: its listing does not end")


def _text(entry: ET.Element, name: str) -> str:
    return entry.findtext(f"{{*}}{name}") or ""


def _download(bucket: str, entry: S3Object, file: Path, tick: Callable[[int], None]) -> None:
    """Download what is missing of an object, and check its size and MD5."""
    if file.is_file() and file.stat().st_size == entry.size:
        tick(entry.size)
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    part, url = file.with_name(file.name + ".part"), f"{bucket}/{urllib.parse.quote(entry.key)}"
    with part.open("ab+") as target:  # It may be what an interrupted download left behind
        if target.tell() > entry.size:
            target.truncate(target.seek(0))
        tick(target.tell())
        if target.tell() < entry.size:
            _receive(url, target, entry, tick)
        target.seek(0)
        md5 = hashlib.file_digest(target, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
    # An ETag of another form is no MD5 and cannot be checked
    if _MD5.fullmatch(entry.etag) and md5 != entry.etag:
        part.unlink()
        raise InputError(
            f"{url}: its content is not what the listing says (MD5); start again to fetch it anew"
        )
    os.replace(part, file)


def _receive(
    url: str,
    target: io.BufferedIOBase,
    entry: S3Object | None = None,
    tick: Callable[[int], None] = lambda _: None,
) -> None:
    """Write a page of a listing to a file, or what the file lacks of an object. What may pass is tried again.

    Raises:
        InputError: the answer is too long, an error, or breaks off too often.
    """
    max_bytes = MAX_LISTING_BYTES if entry is None else entry.size
    for attempt in range(TRIES):
        have = target.tell()
        # If-Range sends the rest only if the object is the same as before
        headers = {"Range": f"bytes={have}-", "If-Range": f'"{entry.etag}"'} if have and entry else {}
        try:
            request = urllib.request.Request(url, headers=headers)
        except ValueError as error:
            raise InputError(f"{url}: not an address: {error}") from error
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                if (
                    have and answer.status != http.client.PARTIAL_CONTENT
                ):  # It has changed, or knows no ranges
                    tick(-have)
                    target.truncate(target.seek(0))
                while chunk := answer.read(CHUNK_BYTES):
                    if target.tell() + len(chunk) > max_bytes:
                        raise InputError(f"{url}: it has more than the {max_bytes} bytes that it may have")
                    target.write(chunk)
                    tick(len(chunk))
            if entry is None or target.tell() == entry.size:
                return
            reason: object = f"it ended after {target.tell()} of {entry.size} bytes"
        except urllib.error.HTTPError as error:
            reason = f"error {error.code}"
            if error.code < 500:  # Errors of the server may pass and are tried again; others are final
                raise InputError(f"{url}: {reason} {error.reason}") from error
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = getattr(error, "reason", error)
        if attempt + 1 < TRIES:
            time.sleep(PAUSE_S * 2**attempt)
    raise InputError(f"{url}: {' '.join(str(reason).split())} ({TRIES} tries); start again to go on")
