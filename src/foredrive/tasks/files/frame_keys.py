"""Names of frames, LOG@T_US, as `Example.key` has them: which frame follows another."""

MAX_GAP_S = 1.25
"""Maximum time between two frames of which the later continues the drive of the earlier. Key frames are
0.5 s apart; one of them may be missing."""


def log_of(key: str) -> str:
    """Return the name of the log."""
    return key.rpartition("@")[0]


def time_of(key: str) -> int:
    """Return the time of the log, µs; 0 if the name states none."""
    text = key.rpartition("@")[2]
    return int(text) if text.isdecimal() else 0


def continues(before: str, key: str) -> bool:
    """Return whether a frame is a later one of the same log, at most `MAX_GAP_S` after another."""
    gap_s = 1e-6 * (time_of(key) - time_of(before))
    return log_of(before) == log_of(key) and 0 < gap_s <= MAX_GAP_S
