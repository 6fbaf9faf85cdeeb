"""Answers of an index: by what rows are ranked, what is one hit, what is refused."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from full_disk import files_up_to
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.search.find import collapse, find
from foredrive.search.index import FrameIndex, IndexSettings, Part
from foredrive.search.projection import project_scenes
from foredrive.search.query import Query
from foredrive.search.rows import row_schema
from foredrive.search.saved import add_tag, remove_tag, save_query, saved_queries, tagged
from foredrive.search.target import Target

DIM = 16
MAKING = IndexSettings("plain", "plain-1", DIM, 0.5)
LOGS, FRAMES = ("city_train/a", "city_train/b", "rural_val/it's"), 40


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, DIM)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def made_rows(seed: int = 0) -> pa.Table:
    """Three logs of 20 s, two views each; the last log has no lidar."""
    rng = np.random.default_rng(seed)
    rows = []
    for number, log in enumerate(LOGS):
        for frame in range(FRAMES):
            for view in ("all", "front"):
                image, lidar = directions(rng, 2)
                joint = (image + lidar) / np.linalg.norm(image + lidar)
                blind = number == 2
                rows.append(
                    {
                        "key": f"{log}@{1_000_000 + 500_000 * frame}",
                        "log": log, "folder": f"/logs/{log}", "maps_dir": "/maps", "frame": frame,
                        "t_us": 1_000_000 + 500_000 * frame, "t_s": 0.5 * frame, "view": view,
                        "ego_speed": float(frame % 10), "n_pedestrian": frame % 3,
                        "image": image, "lidar": None if blind else lidar, "joint": image if blind else joint,
                    }
                )  # fmt: skip
    return pa.Table.from_pylist(rows, schema=row_schema(DIM))


@pytest.fixture
def index(tmp_path: Path) -> FrameIndex:
    made = FrameIndex.make(str(tmp_path / "index"), MAKING)
    rows = made_rows()
    of_log = 2 * FRAMES
    parts = [Part(log, 0, FRAMES - 1, "digest") for log in LOGS]
    made.add([(part, rows.slice(n * of_log, of_log)) for n, part in enumerate(parts)])
    return made


@pytest.fixture
def target() -> Target:
    image, lidar = directions(np.random.default_rng(5), 2)
    return Target(image, lidar)


def test_hits_are_the_nearest_rows(index: FrameIndex, target: Target) -> None:
    rows = made_rows()
    cosine = np.array(rows["image"].to_pylist()) @ target.image
    found = find(index, Query(text="x", gap_s=0.0, top=5), target)
    best = {}
    for n in np.argsort(-cosine):  # a moment is one hit, whichever view of it fits better
        best.setdefault((rows["log"][n].as_py(), rows["t_us"][n].as_py()), float(cosine[n]))
    expected = sorted(best.values(), reverse=True)[:5]
    assert [hit.score for hit in found.hits] == pytest.approx(expected, abs=1e-5)
    assert found.exact
    assert found.compared == len(rows)


@pytest.mark.parametrize("rule", ["features", "logits", "rerank"])
@pytest.mark.parametrize("modality", ["image", "lidar", "joint"])
def test_looking_up_finds_what_comparing_all_does(
    index: FrameIndex, target: Target, modality: str, rule: str
) -> None:
    query = Query(text="x", modality=modality, rule=rule, top=4, where="ego_speed > 2")
    exact, looked_up = find(index, query, target), find(index, query, target, exact_up_to=0)
    assert not looked_up.exact
    assert [hit.row for hit in looked_up.hits] == [hit.row for hit in exact.hits]
    assert [hit.score for hit in looked_up.hits] == pytest.approx([hit.score for hit in exact.hits], abs=1e-5)


def test_partitions_find_what_comparing_all_does_and_grow_with_the_rows(
    index: FrameIndex, target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("foredrive.search.index.PARTITION_ROWS", 40)
    index.optimise(exact_up_to=100)
    names = {made.name for made in index._frames.list_indices()}
    assert names == {"image_6", "lidar_4", "joint_6"}  # of 240 rows 160 have lidar
    query = Query(text="x", gap_s=0.0, top=5)
    expected = [hit.row for hit in find(index, query, target).hits]
    assert [hit.row for hit in find(index, query, target, exact_up_to=0).hits] == expected
    index.optimise(exact_up_to=100)
    assert {made.name for made in index._frames.list_indices()} == names
    monkeypatch.setattr("foredrive.search.index.PARTITION_ROWS", 20)  # as if there were twice the rows
    index.optimise(exact_up_to=100)
    assert {made.name for made in index._frames.list_indices()} == {"image_12", "lidar_8", "joint_12"}
    assert [hit.row for hit in find(index, query, target, exact_up_to=0).hits] == expected


def test_joint_rules_are_the_papers(index: FrameIndex, target: Target) -> None:
    by_rule = {
        rule: find(index, Query(text="x", modality="joint", rule=rule, top=3), target).hits
        for rule in ("features", "logits", "rerank")
    }
    for hit in by_rule["features"]:
        assert hit.score == pytest.approx(hit.scores["joint"])
    for hit in by_rule["logits"]:
        assert hit.score == pytest.approx(hit.scores["image"] + hit.scores.get("lidar", hit.scores["image"]))
        assert hit.scores.get("joint", hit.score / 2) == pytest.approx(hit.score / 2)
    blind = find(
        index, Query(text="x", modality="joint", rule="logits", where=f"log LIKE '{LOGS[2][:5]}%'"), target
    )
    assert blind.hits
    for hit in blind.hits:
        assert hit.score == pytest.approx(2 * hit.scores["image"])
    for hit in by_rule["rerank"]:
        assert hit.score == pytest.approx(hit.scores["lidar"])
        assert "joint" not in hit.scores


def test_what_has_no_lidar_is_not_found_by_it(index: FrameIndex, target: Target) -> None:
    found = find(index, Query(text="x", modality="lidar", top=50), target)
    assert {hit.row.log for hit in found.hits} == set(LOGS[:2])


def test_neighbours_in_a_log_are_one_hit(index: FrameIndex, target: Target) -> None:
    hits = find(index, Query(text="x", gap_s=4.0, top=100), target).hits
    for log in LOGS:
        times = sorted(hit.row.t_s for hit in hits if hit.row.log == log)
        assert len(times) >= 3
        assert np.diff(times).min() >= 4.0


def test_an_example_does_not_find_itself(index: FrameIndex, target: Target) -> None:
    moment = (LOGS[0], 1_000_000 + 500_000 * 10)
    hits = find(index, Query(like="a@5s", gap_s=2.0, top=200), target._replace(moment=moment)).hits
    ours = [hit.row.t_s for hit in hits if hit.row.log == LOGS[0]]
    assert ours
    assert all(abs(t_s - 5.0) >= 2.0 for t_s in ours)


def test_conditions_hold_for_every_hit(index: FrameIndex, target: Target) -> None:
    query = Query(
        text="x", where="ego_speed > 5 AND log = 'rural_val/it''s'", view="front", top=50, gap_s=0.0
    )
    hits = find(index, query, target).hits
    assert len(hits) == 16  # four of ten frames
    assert {(hit.row.log, hit.row.view) for hit in hits} == {(LOGS[2], "front")}


@pytest.mark.parametrize("where", ["ego_speed >", "nonsense = 3", "log = 'a"])
def test_a_condition_that_makes_no_sense_is_one_line(index: FrameIndex, target: Target, where: str) -> None:
    with pytest.raises(InputError) as caught:
        find(index, Query(text="x", where=where), target)
    assert repr(where) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scores_rank_and_mix_with_likeness(index: FrameIndex, target: Target) -> None:
    missed = {f"{LOGS[1]}@{1_000_000 + 500_000 * n}": {"missed": float(n)} for n in range(FRAMES)}
    assert index.set_scores(missed) == 2 * FRAMES
    assert index.count() == 6 * FRAMES
    worst = find(index, Query(by="score_missed", top=3, gap_s=0.0), None).hits
    assert [hit.row.frame for hit in worst] == [39, 38, 37]
    alone = find(index, Query(text="x", by="score_missed", mix=1.0, top=3, gap_s=0.0), target).hits
    assert [hit.row.t_us for hit in alone] == [hit.row.t_us for hit in worst]
    mixed = find(index, Query(text="x", by="score_missed", mix=0.5, top=1), target).hits[0]
    assert mixed.row.log == LOGS[1]


FULL_AT = [0, *(2**n for n in range(6, 18))]
"""Sizes of files, bytes, from one at which nothing can be written to one at which everything can."""


def test_scores_on_a_full_disk_lose_no_rows(index: FrameIndex) -> None:
    missed = {f"{log}@{1_000_000 + 500_000 * n}": {"missed": float(n)} for log in LOGS for n in range(FRAMES)}
    full = []
    for size in FULL_AT:
        try:
            with files_up_to(size):
                index.set_scores(missed)
        except (OSError, RuntimeError):
            full.append(size)
        left = FrameIndex(index.uri)
        assert left.count() == 6 * FRAMES
        assert left.count("image IS NOT NULL") == 6 * FRAMES
        assert left.count("lidar IS NOT NULL") == 4 * FRAMES
        assert left.count("score_missed IS NOT NULL") == (0 if size in full else 6 * FRAMES)
    assert 0 < len(full) < len(FULL_AT)


def test_a_query_on_a_full_disk_leaves_the_older_one(index: FrameIndex) -> None:
    save_query(index.uri, "wet", "old")
    full = []
    for size in FULL_AT:
        try:
            with files_up_to(size):
                save_query(index.uri, "wet", "new")
        except (OSError, RuntimeError):
            full.append(size)
        assert saved_queries(index.uri) == {"wet": "old" if size in full else "new"}
    assert 0 < len(full) < len(FULL_AT)


def test_tags_and_queries_are_kept(index: FrameIndex, target: Target) -> None:
    moments = [f"{LOGS[2]}@1500000", f"{LOGS[0]}@1000000"]
    add_tag(index.uri, "odd", moments)
    add_tag(index.uri, "odd", moments[:1])
    assert sorted(tagged(index.uri, "odd")) == sorted(moments)
    hits = find(index, Query(text="x", tag="odd", gap_s=0.0), target).hits
    assert sorted(hit.row.key for hit in hits) == sorted(moments)
    remove_tag(index.uri, "odd")
    assert find(index, Query(tag="odd"), None).hits == []
    query = Query(text="rain", where="ego_speed > 5", diverse="facility")
    save_query(index.uri, "wet", "old")
    save_query(index.uri, "wet", query.to_json())
    assert Query.from_json(saved_queries(index.uri)["wet"]) == query


def test_parts_are_put_in_once(index: FrameIndex) -> None:
    rows = made_rows(seed=1).slice(0, 2 * FRAMES)
    part = Part(LOGS[0], 0, FRAMES - 1, "digest")
    index.add([(part, rows)])
    assert index.count() == 6 * FRAMES
    assert index.count(f"log = '{LOGS[0]}'") == 2 * FRAMES
    index.drop(LOGS[0])
    assert {part.log for part in index.parts()} == set(LOGS[1:])
    assert index.count() == 4 * FRAMES


@pytest.mark.parametrize(("spacing", "most"), [(1, 119), (5, 24), (1, 7)])
def test_of_too_many_scenes_an_even_part_is_on_the_plane(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spacing: int, most: int
) -> None:
    """The index has 120 scenes whose frames are `spacing` apart; 24 is every fifth."""
    monkeypatch.setattr("foredrive.search.projection.MOST_POINTS", most)
    rows = made_rows()
    frame = rows.schema.get_field_index("frame")
    rows = rows.set_column(frame, rows.schema[frame], pc.multiply(rows["frame"], spacing).cast("int32"))
    backwards = rows.take(np.arange(len(rows))[::-1])
    chosen = []
    for name, order in (("one", rows), ("other", backwards)):
        index = FrameIndex.make(str(tmp_path / name), MAKING)
        index.add([(Part("all", 0, spacing * (FRAMES - 1), "digest"), order)])
        plane = project_scenes(index)
        assert plane.total == len(LOGS) * FRAMES
        assert most / 2 <= len(plane.rows) <= most
        assert len(plane.xy) == len(plane.rows)
        chosen.append(sorted(row.key for row in plane.rows))
        count = [sum(row.log == log for row in plane.rows) for log in LOGS]
        assert max(count) - min(count) <= 1
    assert chosen[0] == chosen[1]  # whatever the order of the rows


def test_an_index_is_its_towers_own(index: FrameIndex, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"made by the towers plain \(plain-1\), not by other \(clip-2\)"):
        FrameIndex.make(index.uri, IndexSettings("other", "clip-2", DIM, 0.5))
    with pytest.raises(InputError, match=r"a moment every 0\.5 s"):
        FrameIndex.make(index.uri, IndexSettings("plain", "plain-1", DIM, 1.0))
    with pytest.raises(InputError, match="no index here"):
        FrameIndex(str(tmp_path / "nowhere"))
    assert not (tmp_path / "nowhere").exists()


@given(
    times=st.lists(st.integers(0, 50), min_size=1, max_size=40),
    gap_s=st.floats(0, 10),
    top=st.integers(1, 10),
)
@settings(max_examples=50, deadline=None)
def test_collapsing_leaves_no_neighbours_and_no_gaps(times: list[int], gap_s: float, top: int) -> None:
    rng = np.random.default_rng(len(times))
    t_us = np.array(times) * 1_000_000
    logs = [f"log {n % 3}" for n in range(len(times))]
    score = rng.normal(size=len(times))
    score[::7] = np.nan
    kept = collapse(score, logs, t_us, gap_s, top)

    def near(a: int, b: int) -> bool:
        return logs[a] == logs[b] and abs(t_us[a] - t_us[b]) < max(gap_s * 1e6, 1)

    assert not any(near(a, b) for a in kept for b in kept if a != b)
    assert (np.diff(score[kept]) <= 0).all()
    left = [n for n in range(len(times)) if n not in kept and not np.isnan(score[n])]
    if len(kept) < top:  # whatever was left out is a neighbour of something better
        assert all(any(near(n, k) and score[k] >= score[n] for k in kept) for n in left)
