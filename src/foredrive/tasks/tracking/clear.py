"""CLEAR MOT: tracks matched frame by frame, and the errors that are counted.

Sources: Bernardin and Stiefelhagen (2008); the order of steps is that of motmetrics 1.4.0 (mot.py, update).
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets.assignment import solve

MISS, MATCH, SWITCH = 0, 1, 2
MOSTLY_TRACKED, MOSTLY_LOST = 0.8, 0.2
"""Shares of a true track's boxes that are found: at least, and less than."""

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


@dataclass(frozen=True)
class TrackRows:
    """Boxes of tracks, one a row, in the order of frames; within a frame in any order.

    Frames and tracks of several sequences have numbers of their own.
    """

    frame: Int[ndarray, "n"]
    track: Int[ndarray, "n"]

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Candidates:
    """Pairs of a true and a found box of one frame that may be matched, in the order of true rows."""

    true_row: Int[ndarray, "P"]
    found_row: Int[ndarray, "P"]
    value: Float[ndarray, "P"]
    """Distance of the pair; in HOTA its similarity."""


@dataclass(frozen=True)
class ClearEvents:
    """What happened to each true box, and in each frame."""

    kind: Int[ndarray, "n"]
    """`MISS`, `MATCH` or `SWITCH`."""
    found_row: Int[ndarray, "n"]
    """Row of the found box; -1 if missed."""
    distance: Float[ndarray, "n"]
    """Of the pair; 0 if missed."""


@dataclass(frozen=True)
class ClearCounts:
    """Sums over true boxes and tracks. Counts of several sequences can be added."""

    frames: int
    """Number of frames that have a true or a found box."""
    true: int
    matches: int
    switches: int
    misses: int
    false: int
    distance_sum: float
    """Over matches and switches."""
    tracks: int
    """Number of true tracks."""
    mostly_tracked: int
    mostly_lost: int
    fragments: int
    """Number of gaps in the detection of a true track."""
    tracked: int
    """Number of true tracks that are found at least once."""
    frames_to_first: int
    """Sum over found tracks of the frames before the first match."""
    longest_gaps: int
    """Sum over found tracks of the longest run of frames without a match, within the track's life."""

    def __add__(self, other: "ClearCounts") -> "ClearCounts":
        return ClearCounts(**{name: value + vars(other)[name] for name, value in vars(self).items()})

    @property
    def mota(self) -> float:
        """1 - (misses + false + switches) / true boxes; it may be negative. NaN without true boxes."""
        return 1.0 - _ratio(self.misses + self.false + self.switches, self.true)

    @property
    def motp(self) -> float:
        """Mean distance of matches and switches; NaN without any."""
        return _ratio(self.distance_sum, self.matches + self.switches)

    @property
    def recall(self) -> float:
        """Share of true boxes that are found. A switch counts as found."""
        return _ratio(self.matches + self.switches, self.true)

    @property
    def precision(self) -> float:
        """Share of found boxes that have a true box."""
        return _ratio(self.matches + self.switches, self.matches + self.switches + self.false)


def _ratio(part: int | float, whole: int) -> float:
    return part / whole if whole else float("nan")


def clear_mot(
    true: TrackRows,
    predicted: TrackRows,
    candidates: Candidates,
    active: Bool[ndarray, "m"] | None = None,
) -> tuple[ClearEvents, ClearCounts]:
    """Match tracks frame by frame, and count errors.

    In each frame a true track first keeps the found track that it had last, if the two are still candidates.
    The remaining boxes are matched so that as many as possible are, at the least sum of distances. A true
    track that takes another found track than its last is a switch, after any number of frames.

    Args:
        candidates: pairs that are near enough; all others can never be matched.
        active: found rows that take part. None: all.

    Raises:
        InputError: rows are not in the order of frames, or a track has two boxes in one frame.
    """
    for rows, name in ((true, "true"), (predicted, "found")):
        _check_rows(rows, name)
    is_active = np.ones(len(predicted), bool) if active is None else active
    layout = lay_out(true, predicted, candidates)
    events = ClearEvents(*follow(layout, is_active))
    return events, count_events(layout, events, is_active)


def _check_rows(rows: TrackRows, name: str) -> None:
    if (np.diff(rows.frame) < 0).any():
        raise InputError(f"the {name} boxes are not in the order of frames")
    # Sorted by frame and track, a repeated pair is a neighbour of itself
    order = np.lexsort((rows.track, rows.frame))
    again = (np.diff(rows.frame[order]) == 0) & (np.diff(rows.track[order]) == 0)
    if again.any():
        row = order[np.flatnonzero(again)[0]]
        raise InputError(f"the {name} track {rows.track[row]} has two boxes in frame {rows.frame[row]}")


@dataclass(frozen=True)
class Layout:
    """Rows by frame and candidates by true row, as the kernels read them."""

    true_start: Int[ndarray, "F_1"]
    """First true row of each frame that has any box, and the number of rows."""
    found_start: Int[ndarray, "F_1"]
    true_track: Int[ndarray, "n"]
    """Tracks, numbered from 0."""
    found_track: Int[ndarray, "m"]
    candidate_start: Int[ndarray, "n_1"]
    found_row: Int[ndarray, "P"]
    distance: Float[ndarray, "P"]


def lay_out(true: TrackRows, predicted: TrackRows, candidates: Candidates) -> Layout:
    """Return the rows of each frame and the candidates of each true row."""
    # Frames with any box of either side
    frames = np.union1d(true.frame, predicted.frame)
    return Layout(
        _starts(true.frame, frames),
        _starts(predicted.frame, frames),
        # Tracks numbered from 0, so that the kernel indexes arrays by them
        np.unique(true.track, return_inverse=True)[1],
        np.unique(predicted.track, return_inverse=True)[1],
        np.searchsorted(candidates.true_row, np.arange(len(true) + 1)),
        np.ascontiguousarray(candidates.found_row, dtype=np.int64),
        np.ascontiguousarray(candidates.value, dtype=np.float64),
    )


def _starts(frame: Int[ndarray, "n"], frames: Int[ndarray, "F"]) -> Int[ndarray, "F_1"]:
    return np.append(np.searchsorted(frame, frames), len(frame))


def follow(
    layout: Layout, active: Bool[ndarray, "m"]
) -> tuple[Int[ndarray, "n"], Int[ndarray, "n"], Float[ndarray, "n"]]:
    """Return kind, found row and distance of each true box, as `ClearEvents`."""
    return _follow(
        layout.true_start,
        layout.found_start,
        layout.true_track,
        layout.found_track,
        layout.candidate_start,
        layout.found_row,
        layout.distance,
        active,
    )


@_kernel
@no_type_check
def _follow(true_start, found_start, true_track, found_track, start, found_row, distance, active):
    # Arguments: row ranges by frame, tracks by row, candidate
    # ranges by true row, their found rows and distances
    kind, partner = np.zeros(len(true_track), np.int64), np.full(len(true_track), -1)
    apart = np.zeros(len(true_track))
    last = np.full(true_track.max() + 1 if len(true_track) else 0, -1)  # found track by true track
    # Inactive detections are taken from the start
    taken = ~active
    for f in range(len(true_start) - 1):
        rows = range(true_start[f], true_start[f + 1])
        for row in rows:  # keep the track of before
            if last[true_track[row]] >= 0:
                for p in range(start[row], start[row + 1]):
                    present = found_row[p]
                    if not taken[present] and found_track[present] == last[true_track[row]]:
                        kind[row], partner[row], apart[row] = MATCH, present, distance[p]
                        taken[present] = True
                        break
        # The remaining boxes of the frame are matched anew
        _match_rest(rows, start, found_row, distance, taken, partner, apart)
        for row in rows:
            if partner[row] >= 0 and kind[row] == MISS:
                # Another found track than the last one is a switch, after any gap
                track, now = true_track[row], found_track[partner[row]]
                kind[row] = SWITCH if last[track] >= 0 and last[track] != now else MATCH
                last[track] = now
    return kind, partner, apart


@_kernel
@no_type_check
def _match_rest(rows, start, found_row, distance, taken, partner, apart):
    """Match the true rows of one frame that have no partner: as many as possible, at the least distance."""
    left, columns = [-1], [-1]  # typed lists; the first entries are dropped
    for row in rows:
        if partner[row] < 0:
            any_left = False
            for p in range(start[row], start[row + 1]):
                if not taken[found_row[p]]:
                    any_left = True
                    columns.append(found_row[p])
            if any_left:
                left.append(row)
    if len(left) == 1:
        return
    # Rows and columns of the assignment: true rows without a partner, and what they can take
    row_of, column_of = np.array(left[1:]), np.unique(np.array(columns[1:]))
    cost = np.full((len(row_of), len(column_of)), np.inf)
    largest = 1.0
    for i, row in enumerate(row_of):
        for p in range(start[row], start[row + 1]):
            if not taken[found_row[p]]:
                cost[i, np.searchsorted(column_of, found_row[p])] = distance[p]
                largest = max(largest, abs(distance[p]))
    # To leave one row out costs more than any choice of pairs: the number of pairs comes first.
    free = np.full(len(row_of), 2.0 * (len(row_of) + 1) * largest)
    column, _, _ = solve(cost, free)
    for i, row in enumerate(row_of):
        # A column beyond the last one stands for no partner
        if column[i] < len(column_of):
            partner[row], apart[row] = column_of[column[i]], cost[i, column[i]]
            taken[partner[row]] = True


def count_events(layout: Layout, events: ClearEvents, active: Bool[ndarray, "m"]) -> ClearCounts:
    """Return the counts of `follow`'s events."""
    matches, switches = ((events.kind == kind).sum() for kind in (MATCH, SWITCH))
    true = len(events.kind)
    # Active detections before each frame: their differences tell whether a frame has any
    seen = np.concatenate([[0], np.cumsum(active)])[layout.found_start]
    nonempty = (np.diff(layout.true_start) > 0) | (np.diff(seen) > 0)
    # Frames count only if they have a box, so empty ones do not lengthen gaps
    lives = _lives(layout.true_start, layout.true_track, np.cumsum(nonempty), events.kind)
    boxes, hits, fragments, first, gap = lives
    share = hits / np.maximum(boxes, 1)
    tracked = hits > 0
    return ClearCounts(
        frames=int(nonempty.sum()),
        true=true,
        matches=int(matches),
        switches=int(switches),
        misses=int(true - matches - switches),
        false=int(active.sum() - matches - switches),
        distance_sum=float(events.distance.sum()),
        tracks=len(boxes),
        mostly_tracked=int((share >= MOSTLY_TRACKED).sum()),
        mostly_lost=int((share < MOSTLY_LOST).sum()),
        fragments=int(fragments.sum()),
        tracked=int(tracked.sum()),
        frames_to_first=int(first[tracked].sum()),
        longest_gaps=int(gap[tracked].sum()),
    )


@_kernel
@no_type_check
def _lives(true_start, true_track, frame_number, kind):
    """Return, for each true track, its boxes, hits, fragments, frames before the first hit, longest gap."""
    tracks = true_track.max() + 1 if len(true_track) else 0
    # One entry for each true track
    boxes, hits, fragments = np.zeros(tracks), np.zeros(tracks), np.zeros(tracks)
    start, before, now, longest = np.zeros(tracks), np.zeros(tracks), np.zeros(tracks), np.zeros(tracks)
    last, missed = np.zeros(tracks), np.zeros(tracks, np.bool_)  # last frame; a miss since the last hit
    for f in range(len(true_start) - 1):
        for row in range(true_start[f], true_start[f + 1]):
            t, number = true_track[row], frame_number[f]
            if boxes[t] == 0:
                # First box of the track
                start[t] = number
            else:
                now[t] += number - last[t] - 1  # the track had no box meanwhile
            boxes[t] += 1
            last[t] = number
            if kind[row] == MISS:
                now[t] += 1
                # A miss after a hit starts a gap; a hit after it makes it a fragment
                missed[t] = hits[t] > 0
            else:
                if hits[t] == 0:
                    before[t] = number - start[t]
                fragments[t] += missed[t]
                longest[t] = max(longest[t], now[t])
                hits[t], now[t], missed[t] = hits[t] + 1, 0, False
    # A gap at the end of the life counts as well
    return boxes, hits, fragments, before, np.maximum(longest, now)


def near_pairs(
    true_frame: Int[ndarray, "n"],
    true_xy: Float[ndarray, "n 2"],
    found_frame: Int[ndarray, "m"],
    found_xy: Float[ndarray, "m 2"],
    max_distance: float,
) -> Candidates:
    """Return the pairs of one frame whose centres are nearer than a distance. Rows are in order of frames."""
    # Range of found rows in the frame of each true row
    first, last = (np.searchsorted(found_frame, true_frame, side=side) for side in ("left", "right"))
    arrays = (np.ascontiguousarray(xy, np.float64) for xy in (true_xy, found_xy))
    return Candidates(*_near_pairs(first, last, *arrays, max_distance))


@_kernel
@no_type_check
def _near_pairs(first, last, true_xy, found_xy, max_distance):
    # Two passes: count the pairs, then fill arrays of that size
    count = 0
    for fill in range(2):
        if fill == 1:
            true_row, found_row = np.empty(count, np.int64), np.empty(count, np.int64)
            distance = np.empty(count)
            count = 0
        for i in range(len(first)):
            for j in range(first[i], last[i]):
                dx, dy = true_xy[i, 0] - found_xy[j, 0], true_xy[i, 1] - found_xy[j, 1]
                apart = np.sqrt(dx * dx + dy * dy)
                if apart < max_distance:
                    if fill == 1:
                        true_row[count], found_row[count], distance[count] = i, j, apart
                    count += 1
    return true_row, found_row, distance
