"""Failures of many jobs, in one line."""

from collections.abc import Mapping


def listed_failures(reasons: Mapping[str, str], shown: int = 3) -> str:
    """Return the first failed jobs with their reasons, and the number of the others."""
    told = [f"{name} ({reason})" for name, reason in reasons.items()]
    more = f", and {len(told) - shown} more" if len(told) > shown else ""
    return ", ".join(told[:shown]) + more
