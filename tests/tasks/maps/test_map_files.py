"""Files of vector maps: both formats give the same figures, and wrong entries are named."""

import json
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from foredrive.errors import InputError
from foredrive.tasks.maps.files import read_maps
from foredrive.tasks.maps.score import score_map_files

LINE = [[-20.0, 3.0], [0.0, 3.5], [20.0, 3.0]]
OTHER = [[-20.0, -6.0], [20.0, -6.0]]
SQUARE = [[5.0, -3.0], [9.0, -3.0], [9.0, 3.0], [5.0, 3.0], [5.0, -3.0]]


def shifted(points: list[list[float]], metres: float) -> list[list[float]]:
    return [[x, y + metres] for x, y in points]


def maptr(frames: dict[str, list[tuple[str, Any, float]]], *, truth: bool = False) -> dict[str, Any]:
    """Frames of (class, points, score)."""
    listed = []
    for token, vectors in frames.items():
        kept = [{"cls_name": name, "pts": points, "pts_num": len(points)} for name, points, _ in vectors]
        if not truth:
            for record, (_, _, score) in zip(kept, vectors, strict=True):
                record["confidence_level"] = score
        listed.append({"sample_token": token, "vectors": kept})
    return {"GTs": listed} if truth else {"meta": {}, "results": listed}


def streammapnet(
    frames: dict[str, list[tuple[str, Any, float]]],
    *,
    truth: bool = False,
    ids: list[list[int]] | None = None,
) -> dict[str, Any]:
    labels = {"ped_crossing": 0, "divider": 1, "boundary": 2}
    found: dict[str, Any] = {}
    for n, (token, vectors) in enumerate(frames.items()):
        found[token] = {
            "vectors": [points for _, points, _ in vectors],
            "labels": [labels[name] for name, _, _ in vectors],
        }
        if not truth:
            found[token]["scores"] = [score for _, _, score in vectors]
        if ids is not None:
            found[token] |= {"global_ids": ids[n], "scene_name": "one", "local_idx": n}
    return {"meta": {}, "results": found}


def write(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


TRUE = {
    "a": [("divider", LINE, 1.0), ("boundary", OTHER, 1.0), ("ped_crossing", SQUARE, 1.0)],
    "b": [("divider", LINE, 1.0), ("boundary", OTHER, 1.0)],
}
FOUND = {
    "a": [("divider", shifted(LINE, 0.7), 0.9), ("boundary", OTHER, 0.8), ("ped_crossing", SQUARE, 0.3)],
    "b": [("boundary", shifted(OTHER, 0.2), 0.6)],
}


def test_formats_agree(tmp_path: Path) -> None:
    """A divider 0.7 m off in one frame of two: AP 0, .5, .5."""
    results = (maptr(FOUND), streammapnet(FOUND))
    truths = (maptr(TRUE, truth=True), streammapnet(TRUE, truth=True))
    figures = [
        score_map_files(read_maps(write(tmp_path / "r.json", r), write(tmp_path / "t.json", t)))
        for r in results
        for t in truths
    ]
    for other in figures[1:]:
        assert other == figures[0]
    found = figures[0]
    assert found["map.maptr.ap_divider"] == pytest.approx(1 / 3)
    assert found["map.maptr.map"] == pytest.approx((1 / 3 + 1 + 1) / 3)
    assert found["map.streammapnet.map"] == found["map.maptr.map_all_classes"]
    assert (found["area"], found["map.frames_counted"]) == ("60x30", 2)
    assert "map.maptracker.c_map" not in found


def test_identities_give_consistent_map(tmp_path: Path) -> None:
    """The divider is found as 7 and then as 9; frames are told out of order."""
    found = {"a": [("divider", LINE, 0.5)], "b": [("divider", LINE, 0.9)]}
    results = streammapnet(found, ids=[[7], [9]])
    truth = streammapnet({t: [TRUE[t][0]] for t in "ba"}, truth=True, ids=[[1], [1]])
    truth["results"]["b"]["local_idx"], truth["results"]["a"]["local_idx"] = 1, 0
    files = read_maps(write(tmp_path / "r.json", results), write(tmp_path / "t.json", truth))
    assert files.tokens == ["a", "b"]
    figures = score_map_files(files)
    assert figures["map.streammapnet.ap_divider"] == pytest.approx(1.0)
    # false at .9, hit at .5: precision 1/2 at recall 1/2
    assert figures["map.maptracker.c_ap_divider"] == pytest.approx(0.25)
    assert figures["map.maptracker.corrected_c_ap_divider"] == pytest.approx(0.25)


def test_the_area_is_that_of_the_truth(tmp_path: Path) -> None:
    far = {"a": [("divider", [[-50.0, 0.0], [50.0, 0.0]], 1.0)]}
    found = {"a": [("divider", [[-50.0, 1.8], [50.0, 1.8]], 0.9)]}
    files = read_maps(
        write(tmp_path / "r.json", maptr(found)), write(tmp_path / "t.json", maptr(far, truth=True))
    )
    assert files.area == "100x50"
    figures = score_map_files(files)
    assert figures["map.streammapnet.ap_divider"] == pytest.approx(1 / 3)
    assert figures["map.maptr.ap_divider"] == 0.0


def test_short_vectors_are_left_out_and_flat_ones_read(tmp_path: Path) -> None:
    found = {"a": [("divider", [[1.0, 1.0]], 0.9), ("divider", [c for p in LINE for c in p], 0.8)]}
    files = read_maps(
        write(tmp_path / "r.json", streammapnet(found)), write(tmp_path / "t.json", maptr(TRUE, truth=True))
    )
    assert (files.short, files.frames_without_results) == (1, 1)
    np.testing.assert_array_equal(files.predicted.lines[0], LINE)


def test_centrelines_count_where_the_truth_has_them(tmp_path: Path) -> None:
    frames = {"a": [("centerline", LINE, 0.7)]}
    files = read_maps(
        write(tmp_path / "r.json", maptr(frames)), write(tmp_path / "t.json", maptr(frames, truth=True))
    )
    figures = score_map_files(files)
    assert figures["map.maptr.ap_centreline"] == pytest.approx(1.0)
    assert figures["map.maptr.map"] == pytest.approx(1.0)


WRONG: dict[str, tuple[Any, str]] = {
    "class": (
        maptr({"a": [("kerb", LINE, 0.9)]}),
        "the class 'kerb' is not one of divider",
    ),
    "label": (
        {"results": {"a": {"vectors": [LINE], "labels": [3], "scores": [0.5]}}},
        "frame a, vector 0: the label 3 is not one of 0 (crossing), 1 (divider), 2 (boundary)",
    ),
    "nan": (
        maptr({"a": [("divider", LINE, 0.9), ("divider", [[0.0, float("nan")], [1.0, 1.0]], 0.9)]}),
        "frame a, vector 1 has a point that is not finite, or beyond 10000 m",
    ),
    "score": (
        maptr({"a": [("divider", LINE, math.inf)]}),
        "frame a, vector 0: the score inf is not a finite number",
    ),
    "no score": (
        maptr({"a": [("divider", LINE, 1.0)]}, truth=True)["GTs"],
        "the score None is not a finite number",
    ),
    "split": (maptr({"x": [], "y": []}), "none of its 2 frames is in "),
    "twice": (
        {"results": [{"sample_token": "a", "vectors": []}, {"sample_token": "a", "vectors": []}]},
        "frame a is there twice",
    ),
    "shape": (
        maptr({"a": [("divider", [[1.0, 2.0, 3.0, 4.0]], 0.5)]}),
        "its points are not pairs of x and y",
    ),
    "text": (maptr({"a": [("divider", [["x", 0]], 0.5)]}), "its points are not numbers"),
    "lists": ({"results": {"a": {"vectors": [LINE], "labels": [1]}}}, "frame a lacks one of the lists"),
    "lengths": (
        {"results": {"a": {"vectors": [LINE], "labels": [1], "scores": []}}},
        "frame a: its lists vectors, labels, scores differ in length",
    ),
    "token": ({"results": [{"vectors": []}]}, "frame 0 has no sample_token"),
    "kind": ("lines", "neither frames in a list (MapTR) nor by token (StreamMapNet)"),
    "identity": (
        streammapnet({"a": [("divider", LINE, 0.9), ("divider", OTHER, 0.9)]}, ids=[[4, 4]]),
        "frame a, vector 1: identity 4 is in frame a twice",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_entries_are_named(name: str, tmp_path: Path) -> None:
    content, message = WRONG[name]
    results = write(tmp_path / "results.json", content)
    truth = write(tmp_path / "truth.json", maptr(TRUE, truth=True))
    with pytest.raises(InputError) as caught:
        read_maps(results, truth)
    assert str(caught.value).startswith(f"{results}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_pickle_of_plain_data_is_the_same_as_json(tmp_path: Path) -> None:
    """MapTracker stores arrays in pickles. What asks for code is refused, and not run."""
    frame = {
        "vectors": [np.array([[-20.0, 3.0], [20.0, 3.0]]), np.array([[-20.0, -9.0], [20.0, -9.0]])],
        "labels": np.array([1, 2]),
        "scores": np.array([0.9, 0.8], np.float32),
        "global_ids": (np.int64(4), 7),
        "scene_name": "a",
        "local_idx": np.int64(0),
    }
    pickled = tmp_path / "pos_predictions.pkl"
    pickled.write_bytes(pickle.dumps({"t": frame}))
    as_lists = {
        name: np.asarray(value).tolist() if name != "scene_name" else value for name, value in frame.items()
    }
    written = write(tmp_path / "pos_predictions.json", {"t": as_lists})
    one, other = (score_map_files(read_maps(path, written)) for path in (pickled, written))
    assert one == other
    assert one["map.maptracker.c_map"] == pytest.approx(2 / 3)  # of three classes, which count 0 if absent
    ran = tmp_path / "ran"
    pickled.write_bytes(f"cos\nsystem\n(S'touch {ran}'\ntR.".encode())
    with pytest.raises(InputError, match=r"pos_predictions\.pkl: .* asks for os.system, which plain data"):
        read_maps(pickled, written)
    assert not ran.exists()
