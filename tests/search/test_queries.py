"""What may be asked, and how examples and clips are written."""

import dataclasses
import json
from pathlib import Path

import pytest
from miniature import miniature

from foredrive.data import ClipDataset, LogPath, find_logs
from foredrive.data.clip_list import ListedClip, clip_list, read_clip_list, write_clip_list
from foredrive.errors import InputError
from foredrive.runs import Run, open_run
from foredrive.runs.train import run as train
from foredrive.search.query import Like, Query, parse_like
from foredrive.search.rows import WHOLE
from foredrive.search.scores import read_scores


@pytest.mark.parametrize(
    ("text", "like"),
    [
        ("town_train/Town01_seed3@12.5s", Like("town_train/Town01_seed3", 12.5, WHOLE, None)),
        ("a@3", Like("a", 3.0, WHOLE, None)),
        ("/data/logs/a b@0s/PCAM_F0", Like("/data/logs/a b", 0.0, "PCAM_F0", None)),
        ("a@1.5s/left:1,2,30,40", Like("a", 1.5, "left", (1, 2, 30, 40))),
    ],
)
def test_examples_are_taken_apart(text: str, like: Like) -> None:
    assert parse_like(text) == like


@pytest.mark.parametrize("text", ["a", "a@", "a@x", "@3s", "a@3s:1,2,3,4", "a@3s/f:1,2,3", "a@3s/f:5,2,5,9"])
def test_what_is_no_example_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_like(text)


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({}, "empty query"),
        ({"text": " "}, "empty text"),
        ({"text": "rain", "where": ""}, "empty where"),
        ({"text": "rain", "like": "a@3s"}, "not both"),
        ({"text": "rain", "top": 0}, "top"),
        ({"by": "caption"}, "no column of numbers caption"),
    ],
)
def test_what_cannot_be_asked_is_one_line(asked: dict[str, object], why: str) -> None:
    with pytest.raises(InputError, match=why):
        Query(**asked)


def test_a_list_of_clips_is_its_logs_with_the_parts_that_are_meant(log: LogPath, tmp_path: Path) -> None:
    path = tmp_path / "clips.json"
    spans = [(1.0, 1.5), (0.2, 0.6), (0.5, 0.8)]
    clips = [ListedClip(log.folder, log.maps_dir, *span) for span in spans]
    write_clip_list(path, clip_list(clips, [{"score": 1}] * 3))
    assert find_logs(path) == [dataclasses.replace(log, parts_s=((0.2, 0.8), (1.0, 1.5)))]


def test_a_data_set_of_listed_clips_has_no_others(log: LogPath) -> None:
    config = dataclasses.replace(
        miniature().clips, past_frames=0, future_frames=0, now_stride_s=0.1, horizon_steps=1
    )

    def nows_s(*parts: tuple[float, float]) -> list[float]:
        listed = dataclasses.replace(log, parts_s=parts)
        dataset = ClipDataset([listed], config, cache_dir=None)
        return [round((dataset.now_us(n) - dataset.now_us(0)) * 1e-6, 3) for n in range(len(dataset))]

    assert nows_s((0.25, 0.55)) == [0.0, 0.1, 0.2]
    assert len(nows_s((0.25, 0.55), (1.0, 1.05))) == 4
    with pytest.raises(InputError, match="none of the selected parts"):
        nows_s((60.0, 70.0))


@pytest.mark.parametrize(
    "text",
    ["", "[]", '{"format": "other", "clips": []}', '{"format": "foredrive clips 1", "clips": []}'],
)
def test_what_is_no_list_of_clips_is_named(text: str, tmp_path: Path) -> None:
    path = tmp_path / "clips.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"clips\.json"):
        read_clip_list(path)


def test_folders_of_a_list_may_lie_beside_it(tmp_path: Path) -> None:
    clip = {"folder": "logs/s/a", "maps_dir": "maps", "start_s": 0, "end_s": 2}
    (tmp_path / "clips.json").write_text(json.dumps({"format": "foredrive clips 1", "clips": [clip]}))
    (read,) = read_clip_list(tmp_path / "clips.json")
    assert (read.folder, read.end_s) == (tmp_path / "logs/s/a", 2.0)
    with pytest.raises(InputError, match="does not exist"):
        find_logs(tmp_path / "clips.json")


def test_scores_come_by_frame(tmp_path: Path) -> None:
    path = tmp_path / "scores.jsonl"
    path.write_text('{"frame": "town_train/a@17", "nll": 3, "missed": 1.5, "else": 9}\n\n')
    assert read_scores(path) == {"town_train/a@17": {"nll": 3.0, "missed": 1.5}}
    path.write_text('{"frame": "a@17"}\n{"frame": "a"}\n')
    with pytest.raises(InputError, match="line 2"):
        read_scores(path)


def test_a_run_remembers_which_parts_of_its_logs_it_learned_from(log: LogPath, tmp_path: Path) -> None:
    listed = dataclasses.replace(log, parts_s=((0.2, 0.8), (1.0, 1.5)))
    run = Run(tmp_path, miniature(), (listed, log), tmp_path / "cache")
    train._write(run)
    assert open_run(tmp_path).logs == run.logs
