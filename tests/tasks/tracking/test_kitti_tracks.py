"""KITTI's tracks: what the benchmark leaves out, by hand, and what wrong files are told."""

from pathlib import Path

import pytest

from foredrive.errors import InputError
from foredrive.tasks.tracking.kitti_tracks import counted_boxes, read_sequence, score_kitti_tracks

HIGH, LOW = 40, 20


def line(frame: int, track: int, x: int, kind: str = "Car", **more: int | str) -> str:
    """A box of 50 px width whose top is at 100 px."""
    said: dict[str, int | str] = {"height": HIGH, "hidden": 0, "cut": 0, "score": "", **more}
    box = f"{x} 100 {x + 50} {100 + int(said['height'])}"
    return (
        f"{frame} {track} {kind} {said['cut']} {said['hidden']} 0 {box} 1.5 1.6 4 0 1.6 20 0 {said['score']}"
    )


def write(folder: Path, *lines: str, name: str = "0000.txt") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def test_one_switch(tmp_path: Path) -> None:
    """A car in four frames, its track changes half-way: 3 matches and a switch.

    HOTA: every box is matched, DetA 1. Each match has 2 of 4 boxes with its partner: AssA 1/2.
    """
    truth = write(tmp_path / "truth", *(line(f, 1, 100) for f in range(4)))
    found = write(tmp_path / "found", *(line(f, 5 + f // 2, 100, score="0.9") for f in range(4)))
    figures = score_kitti_tracks(found, truth)
    assert (figures["tracking.kitti.car.tp"], figures["tracking.kitti.car.ids"]) == (3, 1)
    assert figures["tracking.kitti.car.mota"] == pytest.approx(3 / 4)
    assert figures["tracking.kitti.car.motp_overlap"] == pytest.approx(1.0)
    assert figures["tracking.kitti.car.det_a"] == pytest.approx(1.0)
    assert figures["tracking.kitti.car.hota"] == pytest.approx(0.5**0.5)
    assert not [name for name in figures if "pedestrian" in name]  # the truth has none


def test_sequences_are_not_joined(tmp_path: Path) -> None:
    """The same numbers of frames and tracks mean others in the second sequence, which has no results."""
    for name in ("0000.txt", "0001.txt"):
        truth = write(tmp_path / "truth", line(0, 1, 100), name=name)
    found = write(tmp_path / "found", line(0, 7, 100, score="1"))
    figures = score_kitti_tracks(found, truth)
    assert (figures["tracking.kitti.car.gt"], figures["tracking.kitti.car.fn"]) == (2, 1)
    assert (figures["scenes"], figures["scenes_without_results"]) == (2, 1)


def test_results_in_the_folder_of_other_tools(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    truth = write(tmp_path / "truth", *(line(f, 1, 100) for f in range(4)))
    boxes = (line(f, 1, 100, score="0.9") for f in range(4))
    (tmp_path / "found").mkdir()
    data = write(tmp_path / "found" / "data", *boxes, line(0, 9, 300, "Bus", score="0.9"))
    figures = score_kitti_tracks(tmp_path / "found", truth)
    assert figures["tracking.kitti.car.hota"] == pytest.approx(1.0)
    assert (figures["scenes_without_results"], figures["boxes_of_other_classes_left_out"]) == (0, 1)
    assert caplog.messages == [f"{data}: left out of 5: 1 boxes of other classes"]
    (data / "0000.txt").rename(data / "0007.txt")
    with pytest.raises(InputError, match=r"holds no results of the sequences in .*, such as 0000\.txt"):
        score_kitti_tracks(tmp_path / "found", truth)


def test_boxes_that_do_not_count(tmp_path: Path) -> None:
    """A van, a hidden and a cut car need not be found, and their boxes are not false.

    A box that matches nothing is false, unless it is low, or mostly in a region of no interest.
    """
    truth = write(
        tmp_path / "truth", line(0, 1, 100), line(0, 2, 200, "Van"), line(0, 3, 300, hidden=3),
        line(0, 4, 400, cut=1), line(0, -1, 500, "DontCare"), line(0, 5, 600, "Pedestrian"),
    )  # fmt: skip
    found = write(
        tmp_path / "found", *(line(0, n, x, score="0.5") for n, x in enumerate((100, 200, 300, 400))),
        line(0, 10, 520, score="1"), line(0, 11, 540, score="1"),
        line(0, 12, 700, height=LOW, score="1"), line(0, 13, 800, score="1"),
    )  # fmt: skip
    sides = (read_sequence(folder / "0000.txt", 17) for folder in (truth, found))
    must, kept = counted_boxes(*sides, "car")
    assert must.track.tolist() == [1]
    assert kept.track.tolist() == [0, 11, 13]  # 520 px lies to 3/5 in the region, 540 px to 1/5


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("0 1 Car 0", "line 2 has 4 fields, not 18"),
        (line(0, 1, 100, score="high"), "line 2 has something that is not a number"),
        (line(0, 1, 100, score="nan"), "line 2 has a number that is not finite"),
        (line(0, 7, 100, score="1"), "line 2 has the track 7 a second time in frame 0"),
    ],
)
def test_wrong_lines_are_named(wrong: str, told: str, tmp_path: Path) -> None:
    truth = write(tmp_path / "truth", line(0, 1, 100))
    found = write(tmp_path / "found", line(0, 7, 100, score="1"), wrong)
    with pytest.raises(InputError, match=rf"found/0000\.txt: {told}"):
        score_kitti_tracks(found, truth)


def test_an_unknown_sequence_is_named(tmp_path: Path) -> None:
    truth = write(tmp_path / "truth", line(0, 1, 100))
    for name in ("0000.txt", "0009.txt"):
        found = write(tmp_path / "found", line(0, 7, 100, score="1"), name=name)
    with pytest.raises(InputError, match=r"0009\.txt: there is no such sequence in"):
        score_kitti_tracks(found, truth)
