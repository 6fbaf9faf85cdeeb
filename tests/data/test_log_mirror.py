"""Logs in object storage: clips as from a folder, several processes, a bounded folder, errors in one line."""

import gc
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from multiprocessing.synchronize import Barrier
from pathlib import Path

import pytest
import synthetic_log as world
import torch
from pyarrow import fs
from test_clips import config

from foredrive.cli.main import main
from foredrive.data import ClipDataset, find_logs
from foredrive.data.logs import Log
from foredrive.engine.interrupts import start_fork_server
from foredrive.errors import InputError

pytest.importorskip("moto")
FRAMES, NAMES = 21, ("one", "three", "two")


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root of three logs of one size."""
    root = tmp_path_factory.mktemp("source")
    world.write(root, frames=FRAMES, name=NAMES[0])
    first = find_logs(root)[0].folder
    for name in NAMES[1:]:
        shutil.copytree(first, first.with_name(name))
    (root / "maps" / "a_town").mkdir(parents=True)
    (root / "maps" / "a_town" / "note.txt").write_text("a map")
    return root


@pytest.fixture(scope="module")
def server(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """An S3 server of this machine with the data root in the bucket "drives"."""
    told = tmp_path_factory.mktemp("server") / "told"
    with (
        told.open("w") as out,
        subprocess.Popen([sys.executable, "-m", "moto.server", "-p", "0"], stdout=out, stderr=out) as running,
    ):
        while "Running on" not in told.read_text():
            assert running.poll() is None
            time.sleep(0.05)
        address = told.read_text().split("Running on ")[1].split()[0]
        with pytest.MonkeyPatch.context() as monkeypatch:
            for name, value in (("AWS_ACCESS_KEY_ID", "somebody"), ("AWS_SECRET_ACCESS_KEY", "secret")):
                monkeypatch.setenv(name, value)
            monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            monkeypatch.setenv("AWS_ENDPOINT_URL", address)
            fs.copy_files(str(source), "drives/data", destination_filesystem=storage(address))
            fs.copy_files(str(source / "maps"), "drives/others", destination_filesystem=storage(address))
            yield address
        running.terminate()


def storage(server: str) -> fs.S3FileSystem:
    return fs.S3FileSystem(endpoint_override=server, allow_bucket_creation=True)


@pytest.fixture
def root(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The data root in object storage; the mirror is empty."""
    monkeypatch.setenv("FOREDRIVE_LOGS", str(tmp_path / "mirror"))
    return "s3://drives/data"


def gigabytes(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e9


def mirrored(tmp_path: Path) -> set[str]:
    return {file.parent.name for file in (tmp_path / "mirror").rglob("sync.arrow")}


def test_clips_are_those_of_the_folder(root: str, source: Path, tmp_path: Path) -> None:
    logs = find_logs(Path(root))
    assert [log.folder.name for log in logs] == list(NAMES)
    assert mirrored(tmp_path) == set()
    there = ClipDataset(logs, config(lidar=True, map=True), None)
    here = ClipDataset(find_logs(source), config(lidar=True, map=True), None)
    assert len(there) == len(here) > 0
    assert (tmp_path / "mirror/s3/drives/data/maps/a_town/note.txt").read_text() == "a map"
    assert [there.key(index) for index in range(len(there))] == [
        here.key(index) for index in range(len(here))
    ]
    torch.testing.assert_close(vars(there[0].clip.boxes), vars(here[0].clip.boxes), equal_nan=True)
    assert torch.equal(there[0].clip.images, here[0].clip.images)
    assert torch.equal(there[0].occupancy.values, here[0].occupancy.values)


def test_the_least_recently_used_log_makes_room(
    root: str, source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = find_logs(Path(root))
    size = gigabytes(find_logs(source)[0].folder)
    monkeypatch.setenv("FOREDRIVE_LOGS_GB", str(2.5 * size + gigabytes(source / "maps")))
    one, three = Log(paths[0]), Log(paths[1])
    with pytest.raises(InputError, match=r"two: .* GB do not fit beside the .* GB in use into the .* GB of"):
        Log(paths[2])
    assert mirrored(tmp_path) == {"one", "three"}
    del three
    gc.collect()
    two = Log(paths[2])
    assert mirrored(tmp_path) == {"one", "two"}
    assert len(one) == len(two) == FRAMES
    monkeypatch.setenv("FOREDRIVE_LOGS_GB", str(0.5 * size))
    with pytest.raises(
        InputError, match=r"three: .* GB do not fit into the .* GB of .* \(set FOREDRIVE_LOGS_GB\)"
    ):
        Log(paths[1])


def test_a_changed_log_is_fetched_again(root: str, server: str, tmp_path: Path) -> None:
    path = find_logs(Path(root))[0]
    first = Log(path)
    time.sleep(1.1)  # object storage keeps whole seconds
    other = path.folder.with_name("other")
    shutil.copytree(path.folder, other)
    place = f"drives/data/logs/{path.name}"
    fs.copy_files(str(other), place, destination_filesystem=storage(server))
    again = find_logs(Path(root))[0]
    before = (path.folder / "sync.arrow").stat().st_mtime_ns
    with pytest.raises(InputError, match="has changed, and another process reads its former files"):
        Log(again)
    del first
    gc.collect()
    Log(again)
    assert (path.folder / "sync.arrow").stat().st_mtime_ns > before


def open_all(url: str, environment: dict[str, str], together: Barrier | None) -> None:
    """Open all logs at once; without a barrier, die while they are fetched."""
    os.environ.update(environment)
    if together is None:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    logs = [Log(path) for path in find_logs(Path(url))]
    assert [len(log) for log in logs] == [FRAMES] * len(NAMES)
    if together is not None:
        together.wait(timeout=300)  # each has all logs open while the other has, too


@pytest.mark.slow
def test_processes_share_the_mirror_and_one_may_be_killed(root: str, tmp_path: Path) -> None:
    start_fork_server(preload=open_all.__module__)
    context, environment = multiprocessing.get_context("forkserver"), dict(os.environ)
    barrier = context.Barrier(2)
    processes = [
        context.Process(target=open_all, args=(root, environment, together))
        for together in (None, barrier, barrier)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [-signal.SIGKILL, 0, 0]
    assert mirrored(tmp_path) == set(NAMES)


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("s3://no-such-bucket-here/data", "s3://no-such-bucket-here/data: no such bucket or folder"),
        ("s3://drives/nothing", "/nothing: no such bucket or folder"),
        ("s3://drives/others", "no 123D log here"),
        ("gopher://bucket/data", "gopher://bucket/data: Unrecognized filesystem type"),
        ("s3://me:secret@bucket/data", "credentials and options are in the environment"),
    ],
)
def test_a_wrong_place_is_one_line(
    place: str, message: str, root: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", place]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def test_a_lost_server_is_one_line(root: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = find_logs(Path(root))[0]
    monkeypatch.setattr(
        "foredrive.data.log_mirror._file_system",
        lambda _: fs.S3FileSystem(
            endpoint_override="http://127.0.0.1:1",
            retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=1),
        ),
    )
    with pytest.raises(InputError, match=r"s3://.*/one/.*\.arrow: .*NETWORK_CONNECTION"):
        Log(path)
    assert mirrored(tmp_path) == set()
    assert not list((tmp_path / "mirror" / ".entries").iterdir())
