"""Logs are fetched from a server that speaks S3's listing: in pages, resumed, checked, and bounded."""

import hashlib
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

import pytest

from foredrive.cli.main import main
from foredrive.data.formats import av2_fetch
from foredrive.data.formats.av2_fetch import ROOT, RemoteLog, fetch_log, find_log, log_ids
from foredrive.errors import InputError

LOG, OTHER = "00a6ffc1-6ce9-3bc3-a060-6006e9893a1a", "11a6ffc1-6ce9-3bc3-a060-6006e9893a1a"
START_NS = 315_966_265_259_836_000


class Bucket:
    """A server with the objects of a bucket, and what happened to it."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.etags: dict[str, str] = {}
        self.asked: list[tuple[str, str | None]] = []
        self.cut_at: dict[str, int] = {}
        """Keys whose next answer ends after some bytes."""
        self.fail: dict[str, list[int]] = {}
        """Keys whose next answers are errors."""
        self.page = 3

    def listing(self, query: dict[str, str]) -> str:
        prefix, delimiter = query["prefix"], query.get("delimiter")
        keys = sorted(key for key in self.objects if key.startswith(prefix))
        if delimiter:
            folders = sorted({prefix + key[len(prefix) :].split("/")[0] + "/" for key in keys})
            body = "".join(f"<CommonPrefixes><Prefix>{one}</Prefix></CommonPrefixes>" for one in folders)
            return (
                f"<ListBucketResult xmlns='http://s3.amazonaws.com/doc/2006-03-01/'>{body}</ListBucketResult>"
            )
        start = int(query.get("continuation-token", "0"))
        shown, more = keys[start : start + self.page], start + self.page < len(keys)
        body = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{len(self.objects[key])}</Size>"
            f"<ETag>&quot;{self.etag(key)}&quot;</ETag></Contents>"
            for key in shown
        )
        token = f"<NextContinuationToken>{start + self.page}</NextContinuationToken>" if more else ""
        return (
            "<?xml version='1.0'?><ListBucketResult xmlns='http://s3.amazonaws.com/doc/2006-03-01/'>"
            f"<IsTruncated>{str(more).lower()}</IsTruncated>{body}{token}</ListBucketResult>"
        )

    def etag(self, key: str) -> str:
        return self.etags.get(key) or hashlib.md5(self.objects[key]).hexdigest()


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Bucket, str]]:
    held = Bucket()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            url = urlsplit(self.path)
            if url.path == "/":
                self.answer(200, held.listing({k: v[0] for k, v in parse_qs(url.query).items()}).encode())
                return
            key, asked = unquote(url.path[1:]), self.headers.get("Range")
            held.asked.append((key, asked))
            if held.fail.get(key):
                self.answer(held.fail[key].pop(), b"")
                return
            content, start = held.objects[key], 0
            if asked and self.headers.get("If-Range") == f'"{held.etag(key)}"':
                start = int(asked.removeprefix("bytes=").rstrip("-"))
            self.answer(206 if start else 200, content[start:], held.cut_at.pop(key, None))

        def answer(self, status: int, content: bytes, cut: int | None = None) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[:cut])

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    for name in ("map/a b.json", "annotations.feather", "calibration/intrinsics.feather"):
        held.objects[f"{ROOT}/val/{LOG}/{name}"] = name.encode() * 50
    for k in range(5):
        sweep = f"{ROOT}/val/{LOG}/sensors/lidar/{START_NS + k * 100_000_000}.feather"
        image = f"{ROOT}/val/{LOG}/sensors/cameras/ring_front_center/{START_NS + k * 50_000_000}.jpg"
        held.objects[sweep], held.objects[image] = bytes([k]) * 3000, bytes([k]) * 5000
    held.objects[f"{ROOT}/train/{OTHER}/annotations.feather"] = b"x"
    monkeypatch.setattr(av2_fetch, "CHUNK_BYTES", 512)
    monkeypatch.setattr(av2_fetch, "PAUSE_S", 0.0)
    yield held, f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


def none(_: int) -> None:
    pass


def fetched(folder: Path) -> dict[str, bytes]:
    return {
        f"{ROOT}/{file.relative_to(folder).as_posix()}": file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def test_a_log_is_fetched_in_pages_and_kept(
    bucket: tuple[Bucket, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held, url = bucket
    command = ["fetch", "av2", "--log", LOG, "--out", str(tmp_path), "--bucket", url]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{LOG} (val): 13 files, 0.0 MB\n")
    assert f"fetched {tmp_path / 'val' / LOG}" in said
    mine = {key: content for key, content in held.objects.items() if LOG in key}
    assert fetched(tmp_path) == mine
    held.asked.clear()
    assert main(command) == 0
    assert held.asked == []


def test_a_part_goes_on_where_it_was(bucket: tuple[Bucket, str], tmp_path: Path) -> None:
    held, url = bucket
    log = find_log(LOG, url)
    key = f"{ROOT}/val/{LOG}/sensors/lidar/{START_NS}.feather"
    part = tmp_path / "val" / LOG / "sensors" / "lidar" / f"{START_NS}.feather.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(held.objects[key][:1200])
    came = []
    fetch_log(log, tmp_path, 2, came.append, url)
    assert (key, "bytes=1200-") in held.asked
    assert fetched(tmp_path)[key] == held.objects[key]
    assert sum(came) == log.size
    assert not part.exists()


def one_file(url: str, size: int | None = None) -> RemoteLog:
    """The log's annotations alone."""
    log = find_log(LOG, url)
    (file,) = [file for file in log.files if "annotations" in file.key]
    return replace(log, files=[replace(file, size=file.size if size is None else size)])


def test_a_connection_that_breaks_is_taken_up_again(bucket: tuple[Bucket, str], tmp_path: Path) -> None:
    held, url = bucket
    log = one_file(url)
    key, file = log.files[0].key, Path("val") / LOG / "annotations.feather"
    held.cut_at[key] = 100
    came = []
    fetch_log(log, tmp_path / "a", 1, came.append, url)
    assert held.asked == [(key, None), (key, "bytes=100-")]
    assert (tmp_path / "a" / file).read_bytes() == held.objects[key]
    assert sum(came) == log.size
    held.fail[key] = [503] * 3
    fetch_log(log, tmp_path / "b", 1, none, url)
    assert (tmp_path / "b" / file).read_bytes() == held.objects[key]
    held.fail[key] = [503] * 4
    with pytest.raises(InputError, match=r"error 503 \(4 tries\); start again to go on"):
        fetch_log(log, tmp_path / "c", 1, none, url)
    assert not (tmp_path / "c" / file).exists()
    held.fail[key] = [404]
    with pytest.raises(InputError, match=r"annotations.feather: error 404 Not Found"):
        fetch_log(log, tmp_path / "c", 1, none, url)


@pytest.mark.parametrize("left", [120, 5000])
def test_an_object_that_changed_is_fetched_anew(
    left: int, bucket: tuple[Bucket, str], tmp_path: Path
) -> None:
    held, url = bucket
    log = one_file(url)
    key, folder = log.files[0].key, tmp_path / "val" / LOG
    folder.mkdir(parents=True)
    (folder / "annotations.feather.part").write_bytes(b"x" * left)
    came = []
    held.etags[key] = "0" * 32  # the server's object is another one now
    held.objects[key] = b"y" * log.size
    with pytest.raises(InputError, match="not what the listing says"):
        fetch_log(log, tmp_path, 1, came.append, url)
    assert sum(came) == log.size
    assert not list(folder.iterdir())


def test_objects_uploaded_in_parts_are_checked_by_size(bucket: tuple[Bucket, str], tmp_path: Path) -> None:
    held, url = bucket
    log = one_file(url)
    held.etags[log.files[0].key] = "0123456789abcdef0123456789abcdef-2"
    fetch_log(one_file(url), tmp_path / "a", 1, none, url)
    assert fetched(tmp_path / "a") == {log.files[0].key: held.objects[log.files[0].key]}
    with pytest.raises(InputError, match="more than the"):
        fetch_log(one_file(url, size=log.size - 5), tmp_path / "b", 1, none, url)


def test_a_few_seconds_without_images(bucket: tuple[Bucket, str]) -> None:
    _, url = bucket
    names = [file.key.rpartition("/")[2] for file in find_log(LOG, url, seconds=0.2, images=False).files]
    assert sorted(name for name in names if name[0] == "3") == [
        f"{START_NS + k * 100_000_000}.feather" for k in range(3)
    ]
    assert {"annotations.feather", "intrinsics.feather", "a b.json"} <= set(names)
    images = [file for file in find_log(LOG, url, seconds=0.1).files if file.key.endswith(".jpg")]
    assert len(images) == 3


def test_logs_are_found_in_their_splits(
    bucket: tuple[Bucket, str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    _, url = bucket
    assert find_log(OTHER, url).split == "train"
    assert log_ids("train", url) == [OTHER]
    assert main(["fetch", "av2", "--bucket", url, "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith(f"{LOG}\n1 of the 1 logs of val")


@pytest.mark.parametrize(
    ("log", "told"),
    [("../../etc", "is not the name of"), (LOG.replace("0", "9"), "no log .* in train, val, test")],
)
def test_a_wrong_name_is_told(log: str, told: str, bucket: tuple[Bucket, str]) -> None:
    with pytest.raises(InputError, match=told):
        find_log(log, bucket[1])


def test_a_bucket_cannot_write_elsewhere(bucket: tuple[Bucket, str]) -> None:
    held, url = bucket
    held.objects[f"{ROOT}/val/{LOG}/../../../../x"] = b"x"
    with pytest.raises(InputError, match="is not in the folder"):
        find_log(LOG, url)


def test_what_is_no_bucket_is_told(bucket: tuple[Bucket, str], monkeypatch: pytest.MonkeyPatch) -> None:
    held, url = bucket
    for answer, told in (
        ("<html><p>hello", "does not answer with a listing"),
        ("<a><Contents><Key>k</Key></Contents></a>", "without a size"),
        ("<a>" + "x" * 2**25, "more than"),
        ("<a><IsTruncated>true</IsTruncated><NextContinuationToken>1</NextContinuationToken></a>", "not end"),
    ):
        monkeypatch.setattr(held, "listing", lambda _, answer=answer: answer)
        with pytest.raises(InputError, match=told):
            find_log(LOG, url)
    with pytest.raises(InputError, match="not an address"):
        find_log(LOG, "nowhere")
    with pytest.raises(InputError, match=r"Connection refused \(4 tries\)"):
        log_ids("val", "http://127.0.0.1:1")


def test_a_disk_that_is_too_small_is_told_first(bucket: tuple[Bucket, str], tmp_path: Path) -> None:
    held, url = bucket
    log = find_log(LOG, url)
    huge = av2_fetch.S3Object(log.files[0].key, 10**18, "x")
    with pytest.raises(InputError, match="GB are missing, but the disk has"):
        fetch_log(type(log)(log.log_id, log.split, [huge]), tmp_path, 1, none, url)
    assert held.asked == []
