"""Outcome and score of one drive of a safety test.

The score is that of NeuroNCAP (Ljungbergh et al., ECCV 2024, sec. 3.3): 5 without a collision, else
4 · max(0, 1 - v_impact / v_reference). A vehicle that never moves scores 5 as well. So the share of the way
that was driven (progress) and score × progress stand beside every score.
"""

import enum
import math
from dataclasses import dataclass

from foredrive.driving.drive import Drive
from foredrive.driving.replay.threats import Threat
from foredrive.driving.scores import Ending
from foredrive.errors import InputError
from foredrive.scene import Event

BEST, AFTER_COLLISION = 5.0, 4.0
LEFT_WAY_SCORE = 0.0
"""Score of a drive that leaves the way. NeuroNCAP has no rule for it and would give 5. A vehicle beside the
road has not avoided the accident: NAVSIM's and HUGSIM's scores are 0 off the drivable area (drivable area
compliance), and AlpaSim's too."""


class Outcome(enum.StrEnum):
    """The way in which a safety test ended."""

    PASSED = "passed"
    """The vehicle drove all of the way without a collision."""
    STOPPED_SHORT = "stopped_short"
    """There was no collision, but the time was over, or the vehicle was blocked, before the way's end."""
    LEFT_WAY = "left_way"
    """The vehicle left the way without a collision before, so that nothing could be shown any more."""
    COLLIDED = "collided"
    UNTRUSTED = "untrusted"
    """The vehicle left the region in which the images are trusted, without a collision before. It has no
    score."""
    FAILED = "failed"
    """The agent raised an error or returned no plan, without a collision before. It has no score."""


OUTCOME_OF = {
    Ending.COMPLETED: Outcome.PASSED,
    Ending.TIMEOUT: Outcome.STOPPED_SHORT,
    Ending.BLOCKED: Outcome.STOPPED_SHORT,
    Ending.DEVIATION: Outcome.LEFT_WAY,
    Ending.UNTRUSTED: Outcome.UNTRUSTED,
    Ending.CRASHED: Outcome.FAILED,
}
"""Outcome of a drive without a collision, by its ending."""


@dataclass(frozen=True)
class SafetyResult:
    """Result of a safety test."""

    kind: Threat
    outcome: Outcome
    impact_mps: float | None
    """Speed of the first impact relative to the actor that was hit, m/s. None without a collision."""
    impact_s: float | None
    """Time from the start to the first impact, s. None without a collision."""
    reference_mps: float
    """Impact speed of a vehicle that takes no action, m/s."""
    score: float | None
    """0 to 5. None for a drive that failed or was not trusted to its end: it is counted and never scored."""
    progress: float
    """Share of the way that was driven, 0 to 1."""
    track: int | None = None
    """Track of the vehicle that was sent; None where several were, or none."""
    hd_score: float | None = None
    """HUGSIM's HD-Score, 0 to 1. None without a map, and for a failed drive."""

    @property
    def score_progress(self) -> float | None:
        """Return score × progress. None for a failed drive."""
        return None if self.score is None else self.score * self.progress


def threat_score(impact_mps: float | None, reference_mps: float) -> float:
    """Return NeuroNCAP's score: 5 without a collision (None), else 4 · max(0, 1 - v_impact / v_reference).

    Raises:
        InputError: the reference speed is not positive and finite.
    """
    if not (math.isfinite(reference_mps) and reference_mps > 0):
        raise InputError(f"the reference speed of an impact must be above 0 m/s, got {reference_mps:g}")
    if impact_mps is None:
        return BEST
    return AFTER_COLLISION * max(0.0, 1.0 - impact_mps / reference_mps)


def first_collision(drive: Drive) -> Event | None:
    """Return the first collision of the ego vehicle. None without one."""
    return next((event for event in drive.events if event.kind.startswith("collision_")), None)


def judge(
    kind: Threat,
    drive: Drive,
    reference_mps: float,
    left_way_score: float = LEFT_WAY_SCORE,
    track: int | None = None,
) -> SafetyResult:
    """Score a drive by its first collision, or by its ending if there is none.

    A test ends at the first collision. What happens to a drive afterwards, an error of the agent included,
    changes nothing.
    """
    hit = first_collision(drive)
    # A collision decides, whatever the drive's own ending
    impact_mps = None if hit is None else hit.severity
    outcome = OUTCOME_OF[drive.score.ending] if hit is None else Outcome.COLLIDED
    scores = {Outcome.FAILED: None, Outcome.UNTRUSTED: None, Outcome.LEFT_WAY: left_way_score}
    return SafetyResult(
        kind=kind,
        outcome=outcome,
        impact_mps=impact_mps,
        impact_s=None if hit is None else hit.t_s,
        reference_mps=reference_mps,
        score=scores.get(outcome, threat_score(impact_mps, reference_mps)),
        progress=drive.score.completion,
        track=track,
    )
