"""CLEAR MOT on cases worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.tasks.tracking.clear import (
    MATCH,
    MISS,
    SWITCH,
    Candidates,
    ClearCounts,
    TrackRows,
    clear_mot,
    near_pairs,
)

Track = list[tuple[int, float]]
"""Frame and place of the boxes of a track on a line."""


def follow(true: list[Track], found: list[Track], near: float = 2.0) -> tuple[list[int], ClearCounts]:
    """Kinds of events in the order of frames and tracks, and the counts."""
    sides = []
    for tracks in (true, found):
        rows = sorted((frame, n, x) for n, track in enumerate(tracks) for frame, x in track)
        frame, track, x = (np.array([row[k] for row in rows]) for k in range(3))
        sides.append((TrackRows(frame.astype(int), track.astype(int)), np.c_[x, np.zeros(len(x))]))
    (a, a_xy), (b, b_xy) = sides
    events, counts = clear_mot(a, b, near_pairs(a.frame, a_xy, b.frame, b_xy, near))
    return events.kind.tolist(), counts


def at(*frames: int, x: float = 0.0) -> Track:
    return [(frame, x) for frame in frames]


def test_a_track_is_kept_although_another_is_nearer() -> None:
    """Found track 0 is 1 m off all the time. Track 1 sits on the object from frame 1 on: it is false."""
    kinds, counts = follow([at(0, 1, 2)], [at(0, 1, 2, x=1.0), at(1, 2)])
    assert kinds == [MATCH] * 3
    assert (counts.false, counts.switches, counts.distance_sum) == (2, 0, 3.0)
    assert counts.mota == pytest.approx(1 - 2 / 3)


def test_a_switch_is_found_but_no_match() -> None:
    """Recall counts it, matches do not: 3 of 4 boxes match, 4 of 4 are found."""
    kinds, counts = follow([at(0, 1, 2, 3)], [at(0, 1), at(2, 3)])
    assert kinds == [MATCH, MATCH, SWITCH, MATCH]
    assert (counts.recall, counts.matches, counts.switches) == (1.0, 3, 1)
    assert counts.mota == pytest.approx(1 - 1 / 4)


def test_a_track_is_remembered_over_a_gap() -> None:
    """After two missed frames the same track is no switch, another one is."""
    assert follow([at(0, 1, 2, 3)], [at(0, 3)])[0] == [MATCH, MISS, MISS, MATCH]
    assert follow([at(0, 1, 2, 3)], [at(0), at(3)])[0] == [MATCH, MISS, MISS, SWITCH]


def test_the_number_of_pairs_comes_before_their_distance() -> None:
    """The nearest pair alone (0.1 m) would leave an object without a partner: two pairs of 1.9 m."""
    kinds, counts = follow([at(0, x=0.0), at(0, x=2.0)], [at(0, x=1.9), at(0, x=3.9)])
    assert kinds == [MATCH, MATCH]
    assert counts.distance_sum == pytest.approx(3.8)


def test_fragments_gaps_and_the_first_match() -> None:
    """Frames 0 and 1 missed, 2 found, 3 to 5 missed, 6 and 8 found, 9 missed.

    Gaps between matches: 3 to 5, and 7. The longest run of misses is 3 frames; 2 pass before the first match.
    """
    _, counts = follow([at(*range(10))], [at(2, 6, 8)])
    assert (counts.fragments, counts.longest_gaps, counts.frames_to_first) == (2, 3, 2)
    assert (counts.tracks, counts.tracked, counts.mostly_tracked, counts.mostly_lost) == (1, 1, 0, 0)


def test_shares_that_make_a_track_mostly_tracked_or_lost() -> None:
    """4 of 5 boxes are mostly tracked; 1 of 5 is not yet mostly lost, none is."""
    true = [at(*range(5)), at(*range(5), x=10.0), at(*range(5), x=20.0)]
    _, counts = follow(true, [at(0, 1, 2, 3), at(0, x=10.0)])
    assert (counts.mostly_tracked, counts.mostly_lost, counts.tracked) == (1, 1, 2)


def test_frames_without_any_box_do_not_pass() -> None:
    """No box at all in frames 1 to 8: the object waits one frame for its first match, not nine."""
    _, counts = follow([at(0, 9)], [at(9)])
    assert (counts.frames, counts.frames_to_first) == (2, 1)


def test_only_active_boxes_take_part() -> None:
    true, found = TrackRows(np.zeros(1, int), np.zeros(1, int)), TrackRows(np.zeros(2, int), np.arange(2))
    pairs = Candidates(np.zeros(2, int), np.arange(2), np.array([0.1, 0.5]))
    _, counts = clear_mot(true, found, pairs, np.array([False, True]))
    assert (counts.matches, counts.false, counts.distance_sum) == (1, 0, 0.5)


def test_counts_of_sequences_add_up() -> None:
    one, other = follow([at(0, 1)], [at(0)])[1], follow([at(0)], [at(0), at(0, x=9.0)])[1]
    both = one + other
    assert (both.true, both.matches, both.misses, both.false, both.frames) == (3, 2, 1, 1, 3)


def test_wrong_rows_are_named() -> None:
    rows, none = TrackRows(np.array([4, 4]), np.array([7, 7])), TrackRows(np.zeros(0, int), np.zeros(0, int))
    no_pairs = Candidates(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    with pytest.raises(InputError, match="the true track 7 has two boxes in frame 4"):
        clear_mot(rows, none, no_pairs)
    with pytest.raises(InputError, match="the found boxes are not in the order of frames"):
        clear_mot(none, TrackRows(np.array([1, 0]), np.array([0, 0])), no_pairs)


@given(st.integers(0, 10_000))
def test_every_box_is_counted_once(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, found = (
        [[(f, float(x)) for f in range(6) if rng.random() < 0.7] for x in rng.uniform(0, 6, 5)]
        for _ in range(2)
    )
    kinds, counts = follow(true, found)
    assert counts.matches + counts.switches + counts.misses == counts.true == len(kinds)
    assert counts.matches + counts.switches + counts.false == sum(map(len, found))
    assert counts.tracked <= counts.tracks
