"""Ctrl-C in every phase of every verb that writes: 130, one line, nothing half-written, and it can go on.

The program runs as a process of its own group, and the whole group gets SIGINT, as a terminal sends it.
"""

import fnmatch
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from miniature import miniature

from benchmarks.common.program_server import ProgramServer
from foredrive.data import LogPath
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.summary import read_summary
from foredrive.runs import Run, train_run

TESTS = Path(__file__).parents[1]
PATIENCE_S = 300.0
PRELUDE = """
import warnings
warnings.simplefilter("ignore", ResourceWarning)  # Ctrl-C between `open` and `with`
import foredrive.runs.drive.recording, foredrive.runs.evaluate.run, foredrive.runs.train.run
import foredrive.view.overview, foredrive.view.run_report, foredrive.view.summary_tables
from miniature import miniature
from foredrive.runs.recipes.known import RECIPES
RECIPES["miniature"] = miniature()
"""
Sign = Callable[[], bool]


def is_progress(text: str) -> bool:
    """Return whether every line says how far a program is: on a slow machine it shows some."""
    return all(re.search(r": .*\d+ of \d+, |^still \d/\d ", line) for line in text.splitlines())


class Programs:
    """Starts, interrupts and kills programs."""

    def __init__(self, server: ProgramServer) -> None:
        self._server = server

    def finish(self, *args: str | Path) -> None:
        self._server.start(*args)
        code, said = self._server.finish(PATIENCE_S)
        assert code == 0, said
        assert is_progress(said), said

    def interrupt(self, sign: Sign, *args: str | Path) -> None:
        """Start the program, press Ctrl-C when the sign is there, and see it end as it should."""
        group = self._server.start(*args)
        until = time.monotonic() + PATIENCE_S
        while not sign():
            assert self._server.is_running(), f"ended before the sign: {self._server.finish(0.0)}"
            assert time.monotonic() < until, "the sign did not come"
            time.sleep(0.01)
        os.killpg(group, signal.SIGINT)
        code, said = self._server.finish(PATIENCE_S)
        progress, _, last = said.removesuffix("\n").rpartition("\n")
        assert (code, last) == (130, "foredrive: interrupted")
        assert is_progress(progress), progress


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Programs]:
    server = ProgramServer(tmp_path_factory.mktemp("programs"), PRELUDE, [TESTS, TESTS / "data"])
    yield Programs(server)
    server.close()


def all_files(folder: Path) -> set[str]:
    """Files by their path in the folder, scratch files included; a folder may vanish meanwhile."""
    return {os.path.relpath(Path(at, name), folder) for at, _, names in os.walk(folder) for name in names}


def without_cache(folder: Path) -> set[str]:
    return {file for file in all_files(folder) if not file.startswith("cache/")}


def there(folder: Path, pattern: str) -> Sign:
    """A file in `folder` matches, scratch files included."""
    return lambda: bool(fnmatch.filter(all_files(folder), pattern))


def no_scratch(folder: Path) -> bool:
    return not any(".part" in file for file in all_files(folder))


def test_record(programs: Programs, tmp_path: Path) -> None:
    arguments = (
        "record",
        "--town",
        "Town02",
        "--seconds",
        "3",
        "--image-size",
        "36",
        "64",
        "--out",
        tmp_path,
    )
    programs.interrupt(there(tmp_path, "logs/*.part/*"), *arguments)
    assert all_files(tmp_path) == {"maps/foredrive/foredrive_Town02.arrow"}
    programs.finish(*arguments)
    assert "logs/town_train/Town02_seed0/sync.arrow" in all_files(tmp_path)


@pytest.mark.slow
def test_a_campaign_of_recordings(programs: Programs, tmp_path: Path) -> None:
    arguments = ("record", "--town", "Town02", "--seeds", "1..3", "--seconds", "1", "--rate", "2")
    arguments = (*arguments, "--image-size", "36", "64", "--workers", "2", "--out", tmp_path)
    programs.interrupt(there(tmp_path, "logs/*Town02_seed3.*.part/*"), *arguments)
    assert no_scratch(tmp_path)
    whole = {file.parent for file in tmp_path.rglob("sync.arrow")}
    assert 1 <= len(whole) <= 2
    assert not (tmp_path / "contact_sheet.png").exists()
    written = {file: file.stat().st_mtime_ns for log in whole for file in log.iterdir()}
    programs.finish(*arguments)
    assert {file: file.stat().st_mtime_ns for file in written} == written
    assert len(list(tmp_path.rglob("sync.arrow"))) == 3
    assert (tmp_path / "contact_sheet.png").is_file()


@pytest.mark.real
def test_convert(programs: Programs, real_data: Path, tmp_path: Path) -> None:
    programs.interrupt(
        there(tmp_path, "logs/*.part/*"), "convert", "pandaset", real_data / "pandaset", "--out", tmp_path
    )
    assert not [file for file in all_files(tmp_path) if file.startswith("logs/")]
    assert no_scratch(tmp_path)


def test_train(programs: Programs, log: LogPath, trained: Run, tmp_path: Path) -> None:
    arguments = ("train", "miniature", "--logs", log.folder, "--out", tmp_path)
    programs.interrupt(there(tmp_path / "cache", "*.labels"), *arguments)
    assert no_scratch(tmp_path)
    programs.interrupt(there(tmp_path / "finetune", "metrics.jsonl"), *arguments)
    assert no_scratch(tmp_path)
    programs.finish(*arguments)
    assert without_cache(tmp_path) == without_cache(trained.folder)
    for stage in ("pretrain", "finetune"):
        found, expected = (
            [line["loss"] for line in read_metrics(folder / stage / "metrics.jsonl")]
            for folder in (tmp_path, trained.folder)
        )
        assert found == pytest.approx(expected, rel=1e-6)  # another process, other threads
    assert len(expected) == miniature().finetune.schedule.steps


@pytest.mark.slow
def test_evaluate(programs: Programs, log: LogPath, tmp_path: Path) -> None:
    """While labels are made, and while the report is drawn."""
    run = train_run(miniature(), [log], tmp_path / "run").folder
    shutil.rmtree(run / "cache")
    before, out = all_files(run), tmp_path / "out"
    arguments = ("evaluate", run, "--out", out)
    programs.interrupt(there(run / "cache", "*.labels"), *arguments)
    assert not out.exists()
    programs.interrupt(there(out, "*together*.part/summary.json"), *arguments)
    assert not out.exists()
    assert without_cache(run) == before
    assert no_scratch(tmp_path)


@pytest.mark.slow
def test_the_demo_goes_on_from_every_phase(programs: Programs, tmp_path: Path) -> None:
    """The quick demo, interrupted in several of its steps, ends with what an undisturbed one has."""
    run, arguments = tmp_path / "learned", ("demo", "--quick", "--out", tmp_path)
    programs.interrupt(there(tmp_path, "*Town02_seed1_night.*.part/*"), *arguments)
    assert not (tmp_path / "logs/town_train/Town02_seed1_night").exists()
    for sign in (
        lambda: len(read_metrics(run / "pretrain/metrics.jsonl")) > 1,
        lambda: len(read_metrics(run / "finetune/metrics.jsonl")) > 1,
        there(tmp_path / "driven", "drives/*.json"),
        lambda: len(read_metrics(tmp_path / "reconstructed/metrics.jsonl")) > 1,
    ):
        programs.interrupt(sign, *arguments)
        assert no_scratch(tmp_path)
    assert not (tmp_path / "report.html").exists()
    programs.finish(*arguments)
    assert [line["step"] for line in read_metrics(run / "pretrain/metrics.jsonl")] == list(range(1, 13))
    assert read_summary(run / "summary.json")["failed"] == 0
    report = (tmp_path / "report.html").read_text()
    assert report.count('<img alt="" src="data:image/jpeg') == 7  # the covers: no step failed
    # The drive, two that meet the car in the way, and one without failures: nothing is learned from it
    assert report.count("data:image/webp") == 4
    assert "no failures left" in report
    assert "before the round" not in report
