"""Failures of many jobs, in one line."""

from collections.abc import Mapping


def listed_failures(reasons: Mapping[str, str], shown: int = 3) -> str:
    """Return the first failed jobs with their reasons, and the number of the others."""
    texts = [f"{name} ({reason})" for name, reason in reasons.items()]
    more = f", and {len(texts) - shown} more" if len(texts) > shown else ""
    return ", ".join(texts[:shown]) + more
