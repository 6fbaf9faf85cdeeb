"""Indexing logs: what is in is not done again, what has changed is, and what is broken is named."""

import os
import shutil
from pathlib import Path

import pyarrow as pa
import pytest
import torch
from miniature import write_log
from small_towers import save_clip
from transformers import CLIPModel

from foredrive.data import LogPath, find_logs
from foredrive.data.clip_list import write_clip_list
from foredrive.errors import InputError
from foredrive.runs.search import indexing
from foredrive.runs.search.indexing import Job, index_logs
from foredrive.runs.search.searching import ask, listed_clips
from foredrive.runs.search.towers import find_towers
from foredrive.search.crops import Crop
from foredrive.search.index import FrameIndex, IndexSettings
from foredrive.search.query import Query

FRAMES = 21
"""Of 0.1 s: five moments half a second apart, of three views each."""
ROWS = 5 * 3


@pytest.fixture(scope="module")
def towers(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(save_clip(tmp_path_factory.mktemp("towers") / "clip"))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[LogPath]:
    root = tmp_path_factory.mktemp("logs")
    return [write_log(root, name, FRAMES) for name in ("one", "two")]


def test_an_index_is_made_once_goes_on_and_is_asked(
    logs: list[LogPath], towers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = str(tmp_path / "index")
    monkeypatch.setattr(indexing, "PART_FRAMES", 2)
    first = index_logs(logs[:1], uri, towers, 0.5, 1)
    assert (first.logs, first.rows, first.there_before, first.failed) == (1, ROWS, 0, {})
    both = index_logs(logs, uri, towers, 0.5, 1)
    assert (both.logs, both.rows, both.there_before) == (2, ROWS, 3)
    again = index_logs(
        logs, uri, towers, 0.5, 1, scores={f"flat_train/two@{_t_us(logs[1], 5)}": {"nll": 7.0}}
    )
    assert (again.logs, again.rows, again.there_before, again.scored) == (2, 0, 6, 3)
    index = FrameIndex(uri)
    assert index.count() == 2 * ROWS
    assert index.count("score_nll = 7") == 3

    hits = ask(index, Query(text="car at night", view="ahead", gap_s=0.4, top=3)).hits
    assert len(hits) == 3
    assert [hit.score for hit in hits] == sorted((hit.score for hit in hits), reverse=True)
    itself = ask(index, Query(like="two@1s/left", gap_s=0.4, view="left", top=9)).hits
    assert len(itself) == 9  # of ten moments one is the example
    other = next(hit for hit in itself if hit.row.log == "flat_train/one" and hit.row.t_s == 1.0)
    assert other.score == pytest.approx(1.0, abs=1e-5)  # the same drive under another name
    listed = tmp_path / "clips.json"
    write_clip_list(listed, listed_clips(hits[:1], 0.3, 0.4))
    (log,) = find_logs(listed)
    t_s = hits[0].row.t_s
    assert log.parts_s == ((max(0.0, t_s - 0.3), t_s + 0.4),)


def test_an_interrupted_index_goes_on_where_it_stopped(
    logs: list[LogPath], towers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = str(tmp_path / "index")
    monkeypatch.setattr(indexing, "PART_FRAMES", 2)
    embed, done = indexing.embed_part, []

    def interrupted_at_the_third(job: Job, towers: str, threads: int | None = None) -> pa.Table:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(job)
        return embed(job, towers, threads)

    monkeypatch.setattr(indexing, "embed_part", interrupted_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        index_logs(logs[:1], uri, towers, 0.5, 1)
    assert FrameIndex(uri).count() == 4 * 3
    monkeypatch.setattr(indexing, "embed_part", embed)
    rest = index_logs(logs[:1], uri, towers, 0.5, 1)
    assert (rest.rows, rest.there_before) == (3, 2)
    assert FrameIndex(uri).count() == ROWS


def test_an_index_of_a_relative_path_is_asked_from_another_folder(
    logs: list[LogPath], towers: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uri = str(tmp_path / "index")
    root = logs[0].maps_dir.parent
    monkeypatch.chdir(root)
    index_logs([LogPath(logs[0].folder.relative_to(root), Path("maps"))], uri, towers, 0.5, 1)
    monkeypatch.chdir(tmp_path)
    (hit, *_) = ask(FrameIndex(uri), Query(like="one@1s/left", gap_s=0.4, view="left")).hits
    assert hit.row.folder == logs[0].folder


def test_a_log_that_has_changed_is_put_in_anew(towers: str, tmp_path: Path) -> None:
    uri = str(tmp_path / "index")
    log = write_log(tmp_path, "changing", FRAMES)
    index_logs([log], uri, towers, 0.5, 1)
    os.utime(log.folder / "sync.arrow", (0, 0))
    done = index_logs([log], uri, towers, 0.5, 1)
    assert (done.failed, done.rows, done.there_before) == ({}, ROWS, 0)
    assert FrameIndex(uri).count() == ROWS
    assert len(FrameIndex(uri).parts()) == 1


def test_broken_logs_are_skipped_and_named(logs: list[LogPath], towers: str, tmp_path: Path) -> None:
    broken, unreadable = (write_log(tmp_path, name, FRAMES) for name in ("broken", "unreadable"))
    (broken.folder / "ego_state_se3.arrow").write_bytes(b"not a table")
    images = broken.folder.parent / "unreadable" / "camera.pcam_f0.arrow"
    images.write_bytes(images.read_bytes().replace(b"\xff\xd8\xff", b"\x00\x00\x00"))
    done = index_logs([*logs[:1], broken, unreadable], str(tmp_path / "index"), towers, 0.5, 1)
    assert (done.logs, done.rows) == (1, ROWS)
    assert set(done.failed) == {"flat_train/broken", "flat_train/unreadable"}
    assert "ego_state" in done.failed["flat_train/broken"]
    assert "frames 0 to 20" in done.failed["flat_train/unreadable"]
    with pytest.raises(InputError, match="the stride must be above 0 s"):
        index_logs(logs, str(tmp_path / "index"), towers, 0.0, 1)


def test_other_towers_are_refused(logs: list[LogPath], towers: str, tmp_path: Path) -> None:
    uri = str(tmp_path / "index")
    index_logs(logs[:1], uri, towers, 1.0, 1)
    others = tmp_path / "others"
    shutil.copytree(towers, others)
    model = CLIPModel.from_pretrained(others)
    with torch.no_grad():
        model.text_projection.weight += 0.1
    model.save_pretrained(others)
    with pytest.raises(InputError, match="cannot be compared"):
        index_logs(logs[:1], uri, str(others), 1.0, 1)
    with pytest.raises(InputError, match="cannot be compared"):
        ask(FrameIndex(uri), Query(text="rain"), str(others))


def test_an_index_of_sweeps_that_were_not_cut_is_refused(
    logs: list[LogPath], towers: str, tmp_path: Path
) -> None:
    uri = str(tmp_path / "index")
    clip = find_towers(towers)
    assert clip.crop is Crop.MIDDLE_SQUARE
    before = clip.fingerprint.replace("-middle-square", "")
    FrameIndex.make(uri, IndexSettings(clip.name, before, clip.dim, 1.0))
    with pytest.raises(InputError, match="index the logs again in another place"):
        index_logs(logs[:1], uri, towers, 1.0, 1)


def _t_us(log: LogPath, frame: int) -> int:
    from foredrive.data.logs import Log

    return int(Log(log).t_us[frame])
