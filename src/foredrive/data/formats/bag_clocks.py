"""Comparison of the clocks of a bag's topics, by the times at which one recorder received their messages.

The difference of header stamp and recorder's time is about constant for a topic: the offset of its clock,
less the delay until the recorder has the message. Topics of one clock differ by their delays alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from foredrive.data.notices import note
from foredrive.errors import InputError

SAME_S = 0.5
"""Topics whose offsets differ by less have one clock; the rest is delay."""
CLEAR_S = 1.0
"""Stamps that are ahead of those of other topics by more than this are of another clock."""
LATE_S = 10.0
"""Stamps that are behind by more than this are of another clock; less may be the delay of a slow program."""
_LOST_S = 10.0
"""Single stamps that differ by more from those of their topic are wrong."""
_KNOWN_S = (37.0, 18.0, 19.0)
"""Known differences of clocks, s: TAI is ahead of UTC since 2017, GPS of UTC, and TAI of GPS."""
_ZONE_S = 900.0
"""Time zones differ by multiples of this."""


@dataclass(frozen=True)
class Stream:
    """Stamps of one kind of message, in the order of the bag."""

    t_us: Int64[np.ndarray, "N"]
    recorded_us: Int64[np.ndarray, "N"]


@dataclass(frozen=True)
class Corrected:
    """Stamps on the common clock."""

    t_us: Int64[np.ndarray, "N"]
    kept: Bool[np.ndarray, "N"]
    """False for single stamps that are wrong."""


def on_one_clock(streams: Mapping[str, Stream]) -> dict[str, Corrected]:
    """Return the stamps of all streams on one clock, with a notice for each that is corrected or in doubt.

    The common clock is that of the recorder where a stream has it, and that of most streams elsewhere, as in
    a simulation.

    Args:
        streams: at least one message each, by topic.

    Raises:
        InputError: the stamps of a topic are not set, and there is no other topic to compare with.
    """
    offsets_s = {name: _offset_s(stream) for name, stream in streams.items()}
    common_s = _common_offset_s([offset for offset in offsets_s.values() if offset is not None])
    corrected = {}
    for name, stream in streams.items():
        t_us, offset_s = stream.t_us, offsets_s[name]
        kept = np.ones(len(t_us), bool)
        if _is_unset(t_us):
            t_us = _recorded(name, stream, common_s)
        elif offset_s is None:
            if common_s is not None:
                note(name, "header stamps do not run like the recorder's times; clocks were not compared")
        else:
            off_s = (t_us - stream.recorded_us) * 1e-6 - offset_s
            kept = np.abs(off_s) <= _LOST_S
            for row in np.flatnonzero(~kept):
                place = f"message {row}, {t_us[row] * 1e-6:.3f} s"
                note(name, f"stamps more than {_LOST_S:g} s beside those of their topic, left out", place)
            assert common_s is not None
            t_us = t_us - round(_correction_s(name, offset_s - common_s) * 1e6)
        corrected[name] = Corrected(t_us, kept)
    return corrected


def _is_unset(t_us: Int64[np.ndarray, "N"]) -> bool:
    """Return whether all stamps are 0, or all equal, as of a driver that does not set them."""
    return not t_us.any() or (len(t_us) > 1 and bool((t_us == t_us[0]).all()))


def _offset_s(stream: Stream) -> float | None:
    """Return the time by which stamps are ahead of the recorder's times, s, or None if it is not constant."""
    if _is_unset(stream.t_us):
        return None
    off_s = (stream.t_us - stream.recorded_us) * 1e-6
    middle_s = float(np.median(off_s))
    return middle_s if (np.abs(off_s - middle_s) <= CLEAR_S).mean() > 0.5 else None


def _common_offset_s(offsets_s: list[float]) -> float | None:
    """Return the offset of the common clock, or None if no stream has one."""
    if not offsets_s:
        return None
    values: Float64[np.ndarray, S] = np.array(offsets_s)
    near = np.abs(values) <= CLEAR_S
    if near.any():
        return float(np.median(values[near]))
    count = (np.abs(values[:, None] - values) <= SAME_S).sum(axis=1)
    # Of two clocks with as many streams, the first one's
    return float(np.median(values[np.abs(values - values[count.argmax()]) <= SAME_S]))


def _recorded(name: str, stream: Stream, common_s: float | None) -> Int64[np.ndarray, "N"]:
    """Return the recorder's times on the common clock, for a topic without stamps."""
    if common_s is None:
        raise InputError(
            f"{name}: all header stamps are {stream.t_us[0] * 1e-6:g} s, and no other topic has a clock"
        )
    note(
        name,
        f"all header stamps are {stream.t_us[0] * 1e-6:g} s; the recorder's times were used, "
        "which are later by the delay until it had the message",
    )
    return stream.recorded_us + round(common_s * 1e6)


def _correction_s(name: str, ahead_s: float) -> float:
    """Return the time by which the stamps of a topic are put back, s, and note it."""
    if abs(ahead_s) <= SAME_S:
        return 0.0
    way = "ahead of" if ahead_s > 0 else "behind"
    text = f"header stamps are {abs(ahead_s):.3f} s {way} those of other topics, by the recorder's times"
    if not (ahead_s > CLEAR_S or ahead_s < -LATE_S):
        note(name, f"{text}; delay or another clock? They were kept")
        return 0.0
    exact_s = _known_s(ahead_s)
    if exact_s is None:
        note(name, f"{text}; corrected by that, to within the delays of the topics")
        return ahead_s
    note(name, f"{text}; corrected by {-exact_s:+.0f} s")
    return exact_s


def _known_s(ahead_s: float) -> float | None:
    """Return the known difference of two clocks that equals this one but for delays, s, or None."""
    for known_s in (*_KNOWN_S, *(-known for known in _KNOWN_S)):
        if abs(ahead_s - known_s) <= SAME_S:
            return known_s
    zones = round(ahead_s / _ZONE_S) * _ZONE_S
    return zones if zones and abs(zones) <= 14 * 3600 and abs(ahead_s - zones) <= SAME_S else None
