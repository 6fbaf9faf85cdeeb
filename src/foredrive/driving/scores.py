"""Scores of a drive, exactly as CARLA's leaderboards 1.0 and 2.1 compute them.

Driving score = route completion in % × penalty. Leaderboard 1.0 multiplies one factor per infraction.
Leaderboard 2.1 adds one coefficient per infraction and divides by 1 + their sum, so that more infractions
always cost more but a long route keeps some score. Both multiply by the share of the distance that was driven
within the lanes. An early end costs nothing by itself; only the missing completion does.
"""

import enum
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from foredrive.errors import InputError
from foredrive.scene import Event


class InfractionKind(enum.StrEnum):
    """Kinds of infractions. They equal the `kind` of the `Event`s that report them."""

    COLLISION_PEDESTRIAN = "collision_pedestrian"
    COLLISION_VEHICLE = "collision_vehicle"
    COLLISION_STATIC = "collision_static"
    RED_LIGHT = "red_light"
    STOP_SIGN = "stop_sign"
    SCENARIO_TIMEOUT = "scenario_timeout"
    """A scenario was not passed in time. Only in leaderboard 2, as the next two kinds."""
    YIELD_TO_EMERGENCY = "yield_to_emergency"
    MIN_SPEED = "min_speed"
    """Slower than the surrounding traffic, weighted by how much slower."""


class Ending(enum.StrEnum):
    """Reason why a drive ended. It equals the `kind` of the `Event` that reports it."""

    COMPLETED = "completed"
    DEVIATION = "deviation"
    """More than 30 m from the route (InRouteTest)."""
    BLOCKED = "blocked"
    """Slower than 0.1 m/s for 180 s (ActorSpeedAboveThresholdTest)."""
    TIMEOUT = "timeout"
    """Time limit reached, see `timeout_s`."""
    COLLISION = "collision"
    """The first collision, in safety tests alone."""
    UNTRUSTED = "untrusted"
    """The images of a reconstruction were no longer trusted, in drives that are to stay where they are."""
    CRASHED = "crashed"
    """The agent raised an error or returned no plan. The drive is scored up to that point and counts as
    failed."""


FACTOR_1_0 = {
    InfractionKind.COLLISION_PEDESTRIAN: 0.50,
    InfractionKind.COLLISION_VEHICLE: 0.60,
    InfractionKind.COLLISION_STATIC: 0.65,
    InfractionKind.RED_LIGHT: 0.70,
    InfractionKind.STOP_SIGN: 0.80,
}
COEFFICIENT_2_1 = {
    InfractionKind.COLLISION_PEDESTRIAN: 1.0,
    InfractionKind.COLLISION_VEHICLE: 0.70,
    InfractionKind.COLLISION_STATIC: 0.60,
    InfractionKind.RED_LIGHT: 0.40,
    InfractionKind.STOP_SIGN: 0.25,
    InfractionKind.SCENARIO_TIMEOUT: 0.40,
    InfractionKind.YIELD_TO_EMERGENCY: 0.40,
    InfractionKind.MIN_SPEED: 0.40,
}
SECONDS_PER_M, SECONDS_TO_START = 0.8, 5.0
"""SECONDS_GIVEN_PER_METERS and INITIAL_SECONDS_DELAY of leaderboard 1.0."""


def timeout_s(route_m: float) -> float:
    """Return the time limit of a route, s."""
    return float(int(SECONDS_PER_M * route_m + SECONDS_TO_START))


@dataclass(frozen=True)
class Infraction:
    """An event that is penalised."""

    kind: InfractionKind
    t_s: float
    """Time since the drive began, s."""
    xy_world: tuple[float, float]
    severity: float = 0.0
    """Impact speed of a collision, m/s. For MIN_SPEED, the share of the traffic's speed that the vehicle
    reached."""
    what: str = ""
    """Object that was hit, or line that was crossed."""
    detail: str = ""


def infraction_of(event: Event) -> Infraction | None:
    """Return the infraction that an event reports. None if it reports no infraction."""
    if event.kind not in set(InfractionKind):
        return None
    kind = InfractionKind(event.kind)
    return Infraction(kind, event.t_s, event.xy_world, event.severity, event.what, event.detail)


@dataclass(frozen=True)
class RouteScore:
    """Score of one drive of one route."""

    route: str
    repetition: int
    completion: float
    """Share of the route that was driven, 0 to 1."""
    outside_lanes: float
    """Share of the distance that was driven outside of the lanes or against them, 0 to 1."""
    ending: Ending
    infractions: tuple[Infraction, ...]
    driven_m: float
    duration_s: float

    def __post_init__(self) -> None:
        shares = (self.completion, self.outside_lanes)
        if not all(0 <= share <= 1 for share in shares):
            raise InputError(
                f"route {self.route}: completion and outside_lanes must be between 0 and 1, got {shares}"
            )

    @property
    def penalty_1_0(self) -> float:
        """Return the product of the factors. Kinds that leaderboard 1.0 does not have cost nothing."""
        factor = 1 - self.outside_lanes
        for infraction in self.infractions:
            factor *= FACTOR_1_0.get(infraction.kind, 1.0)
        return factor

    @property
    def penalty_2_1(self) -> float:
        """Return (1 - outside) / (1 + Σ coefficients)."""
        return (1 - self.outside_lanes) / (1 + sum(map(_coefficient_2_1, self.infractions)))

    @property
    def driving_score_1_0(self) -> float:
        """Return the driving score of leaderboard 1.0, 0 to 100."""
        return 100 * self.completion * self.penalty_1_0

    @property
    def driving_score_2_1(self) -> float:
        """Return the driving score of leaderboard 2.1, 0 to 100."""
        return 100 * self.completion * self.penalty_2_1

    @property
    def failed(self) -> bool:
        """Return whether the agent crashed."""
        return self.ending is Ending.CRASHED


@dataclass(frozen=True)
class MeanSpread:
    """Mean over all drives, and standard deviation of the repetitions' means (0 for one repetition)."""

    mean: float
    spread: float


@dataclass(frozen=True)
class SuiteScore:
    """Score of all drives of a set of routes."""

    routes: int
    repetitions: int
    driving_score_1_0: MeanSpread
    driving_score_2_1: MeanSpread
    completion: MeanSpread
    """In %."""
    failed: int
    endings: dict[Ending, int]
    infractions: dict[InfractionKind, int]
    infractions_per_km: dict[InfractionKind, float]


def score_suite(drives: Sequence[RouteScore]) -> SuiteScore:
    """Average the scores over routes and repetitions.

    Each drive has the same weight, as in CARLA, whatever its length.

    Raises:
        InputError: there is no drive, a drive occurs twice, or a route lacks a repetition that others have.
    """
    keys = [(drive.route, drive.repetition) for drive in drives]
    routes, repetitions = ({key[k] for key in keys} for k in (0, 1))
    if not keys:
        raise InputError("there are no drives to score")
    if len(set(keys)) != len(keys):
        raise InputError(
            f"duplicate drives, (route, repetition): {sorted({key for key in keys if keys.count(key) > 1})}"
        )
    if missing := sorted({(r, n) for r in routes for n in repetitions} - set(keys)):
        raise InputError(f"missing drives, (route, repetition): {missing}; failed drives count too")
    # Kinds without an event count as 0
    kinds = [infraction.kind for drive in drives for infraction in drive.infractions]
    driven_km = sum(drive.driven_m for drive in drives) / 1000
    counts = {kind: kinds.count(kind) for kind in InfractionKind}

    # Mean over all drives, spread over the means of the repetitions
    def over_repetitions(values: list[float]) -> MeanSpread:
        of = [
            statistics.fmean(v for v, (_, n) in zip(values, keys, strict=True) if n == k) for k in repetitions
        ]
        return MeanSpread(statistics.fmean(values), statistics.stdev(of) if len(of) > 1 else 0.0)

    return SuiteScore(
        routes=len(routes),
        repetitions=len(repetitions),
        driving_score_1_0=over_repetitions([drive.driving_score_1_0 for drive in drives]),
        driving_score_2_1=over_repetitions([drive.driving_score_2_1 for drive in drives]),
        completion=over_repetitions([100 * drive.completion for drive in drives]),
        failed=sum(drive.failed for drive in drives),
        endings={ending: sum(drive.ending is ending for drive in drives) for ending in Ending},
        infractions=counts,
        infractions_per_km={kind: n / driven_km if driven_km > 0 else 0.0 for kind, n in counts.items()},
    )


def _coefficient_2_1(infraction: Infraction) -> float:
    """Return the coefficient that an infraction adds to leaderboard 2.1's divisor."""
    coefficient = COEFFICIENT_2_1[infraction.kind]
    if infraction.kind is InfractionKind.MIN_SPEED:
        return coefficient * (1 - min(max(infraction.severity, 0.0), 1.0))
    return coefficient
