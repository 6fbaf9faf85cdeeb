"""Judges how well a driver sees, over packed clips and before any planning."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.data.truth.affordances import PathAhead
from foredrive.driver.agent import Driver
from foredrive.driver.losses import lamp_places
from foredrive.driver.packed import BATCH, PackedClips, join
from foredrive.driver.route_cells import LINE_FROM_M
from foredrive.driving.speed_rule import FRONT_M, PathView, meets_somebody, rule_progress
from foredrive.methods.planner.ego_mlp import ego_speeds
from foredrive.scene.affordances import CELL_M, LATER_DT_S, TIMES, Affordances, PathEstimate
from foredrive.scene.traffic_light import LightState

LIGHT_M, OBSTACLE_M = 40.0, 30.0
"""Distances up to which lights and the first obstacle are judged."""
THRESHOLDS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
FALSE_AT_MOST = 0.1
SIGN_ERROR_M = 4.0
"""Error of its line within which a stop sign counts as seen."""


class Moment(NamedTuple):
    """Judgement of one clip."""

    state: int
    """True `LightState`."""
    named: int
    """The most probable one."""
    light_m: float
    light_error_m: float
    visible: bool
    """True if a lamp of the light is in an image."""
    lit: bool
    """True if the log has the state of the light."""
    sign_m: float
    """Distance of the line of the next stop sign; infinite without one, NaN if the log does not know."""
    sign_seen_m: float
    first: int
    """First cell of the path that is occupied now; -1 without."""
    first_seen: Float[np.ndarray, "K"]
    """The same of the estimate at each of `THRESHOLDS`."""
    conflict: bool
    """True if the vehicle would meet somebody if it drove on, minding its light alone."""
    conflict_seen: Bool[np.ndarray, "K"]
    """The same by the estimate at each of `THRESHOLDS`."""
    crossing: bool
    """The conflict is with somebody who is not in the path now."""

    @property
    def judged(self) -> bool:
        """Return whether there is a light within `LIGHT_M` whose lamps an image shows."""
        lit = self.lit and self.visible and self.state != LightState.NONE
        return lit and self.light_m <= LIGHT_M

    @property
    def missed(self) -> bool:
        """Return whether somebody who would be met is not seen, or whether to stop for the light is wrong."""
        stops = (LightState.RED, LightState.YELLOW)
        wrong = self.judged and (self.state in stops) != (self.named in stops)
        return wrong or (self.conflict and not bool(self.conflict_seen[THRESHOLDS.index(0.5)]))


def judge_sight(
    driver: Driver, clips: PackedClips, tick: Callable[[], None] = lambda: None
) -> dict[str, float]:
    """Return how well a driver sees lights and road users on its route.

    `light_accuracy_40m` and `red_missed_40m` count lights within 40 m with a lamp in an image; a red light is
    missed if neither red nor yellow is named. `sign_recall_30m` is the share of stop signs whose line is seen
    within 4 m of its place, `sign_false` the share of the moments without one in which one is seen.
    `conflict_recall` is the share that is seen of the moments in which the vehicle would meet somebody if it
    drove on and minded its true light alone. It counts at the lowest threshold at which at most 10 % of the
    other moments are taken for such, or at the highest one; `conflict_false` is this share. `crossing_recall`
    counts those with somebody who is not in the path yet. `first_obstacle_error_m` is the median error of the
    first occupied cell now, a missed one counted as the distance to the end of the range.

    Args:
        driver: in evaluation mode.
        clips: with known truth.
        tick: called after each batch.
    """
    return _figures(list(_moments(driver, clips, tick)))


def judge_sight_by(driver: Driver, clips: PackedClips, groups: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the figures of `judge_sight` for each group of clips.

    Args:
        driver: in evaluation mode.
        clips: with known truth.
        groups: the group of each clip.
    """
    of_group: dict[str, list[Moment]] = {}
    for group, moment in zip(groups, _moments(driver, clips, lambda: None), strict=True):
        of_group.setdefault(group, []).append(moment)
    return {group: _figures(moments) for group, moments in sorted(of_group.items())}


def missed_by(
    driver: Driver, clips: PackedClips, tick: Callable[[], None] = lambda: None
) -> Bool[Tensor, "N"]:
    """Return the clips in which a driver misses somebody whom it would meet, or takes a light for another.

    Args:
        driver: in evaluation mode.
        clips: N clips.
        tick: called after each batch.
    """
    return torch.tensor([moment.missed for moment in _moments(driver, clips, tick)])


def uncertainty_of(
    driver: Driver, clips: PackedClips, tick: Callable[[], None] = lambda: None
) -> Float[Tensor, "N"]:
    """Return how unsure a driver is of what it sees, see `uncertainty`; the truth is not looked at.

    Args:
        driver: in evaluation mode.
        clips: N clips.
        tick: called after each batch.
    """
    of_batches = []
    for start in range(0, len(clips), BATCH):
        batch = join([clips[index] for index in range(start, min(start + BATCH, len(clips)))])
        of_batches.append(uncertainty(driver.see(batch.clip).estimate()))
        tick()
    return torch.cat(of_batches)


def uncertainty(estimate: PathEstimate) -> Float[Tensor, "b"]:
    """Return the entropy of the light's state plus the mean entropy of the path's cells over all times.

    Each is relative to its maximum, so the sum is from 0 to 2.
    """
    light, p = estimate.light.clamp(min=1e-6), estimate.occupied.clamp(1e-6, 1 - 1e-6)
    of_light = -(light * light.log()).sum(-1) / math.log(light.shape[-1])
    of_path = -(p * p.log() + (1 - p) * (1 - p).log()) / math.log(2)
    return of_light + of_path.flatten(1).mean(1)


def _moments(driver: Driver, clips: PackedClips, tick: Callable[[], None]) -> Iterator[Moment]:
    for start in range(0, len(clips), BATCH):
        batch = join([clips[index] for index in range(start, min(start + BATCH, len(clips)))])
        # Rows of the batch, with the lamps that lie in an image
        sight = driver.see(batch.clip)
        estimate, speed = sight.estimate(), ego_speeds(batch.clip)[:, batch.clip.now]
        size = (sight.lamp_logits.shape[-2], sight.lamp_logits.shape[-1])
        lamps = lamp_places(batch.truth, batch.clip.rig[:, batch.clip.now], size).inside.flatten(1).any(1)
        for row in range(len(speed)):
            sign_m = float(sight.sign_m[row])
            yield _moment(batch.truth[row], estimate[row], float(speed[row]), bool(lamps[row]), sign_m)
        tick()


def _moment(
    truth: Affordances, estimate: PathEstimate, speed_mps: float, visible: bool, sign_seen_m: float
) -> Moment:
    path = PathAhead(truth.path_xy, np.zeros(len(truth.path_xy)), truth.path_valid, FRONT_M, True)
    # Only what is known counts, in the truth and in the estimate
    occupied = (truth.occupied & truth.occupied_known).numpy()
    p = torch.where(truth.occupied_known, estimate.occupied, 0.0).numpy()
    # Driving on but for the light, for as long as the truth reaches.
    light = LightState(int(truth.light)) if bool(truth.light_known) else LightState.NONE
    # Progress of a vehicle that minds its light but no road user
    free_m = rule_progress(
        path, speed_mps, PathView(light, float(truth.light_m), None, np.zeros_like(occupied))
    )
    times = LATER_DT_S * np.arange(1, TIMES)
    # At the times of the occupancy
    free_m = np.interp(times, LATER_DT_S * np.arange(len(free_m) + 1), np.append(0.0, free_m))
    seen = np.array([meets_somebody(free_m, p >= threshold) for threshold in THRESHOLDS])
    conflict = meets_somebody(free_m, occupied)
    return Moment(
        state=int(truth.light),
        named=int(estimate.light.argmax()),
        light_m=float(truth.light_m),
        light_error_m=abs(float(estimate.light_m) - float(truth.light_m)),
        visible=visible,
        lit=bool(truth.light_known),
        sign_m=_sign_m(truth),
        sign_seen_m=sign_seen_m,
        first=_first(occupied[0]),
        first_seen=np.array([_first(p[0] >= threshold) for threshold in THRESHOLDS], dtype=float),
        conflict=conflict,
        conflict_seen=seen,
        # Meets somebody, but nobody who is in the path already now
        crossing=conflict and not meets_somebody(free_m, occupied & occupied[:1]),
    )


def _sign_m(truth: Affordances) -> float:
    if not bool(truth.sign_known):
        return math.nan
    return float(truth.sign_m) if bool(truth.sign) else math.inf


def _first(occupied: Bool[np.ndarray, "G"]) -> int:
    return int(occupied.argmax()) if occupied.any() else -1


def _figures(moments: list[Moment]) -> dict[str, float]:
    state, named = (np.array([getattr(m, name) for m in moments]) for name in ("state", "named"))
    near, lit = np.array([m.judged for m in moments]), np.array([m.lit for m in moments])
    stops = np.isin(named, [LightState.RED, LightState.YELLOW])
    red, green = near & (state == LightState.RED), near & (state == LightState.GREEN)
    none = lit & (state == LightState.NONE)
    sign_m, sign_seen_m = (
        np.array([getattr(m, name) for m in moments]) for name in ("sign_m", "sign_seen_m")
    )
    sign = (sign_m >= LINE_FROM_M) & (sign_m < OBSTACLE_M)
    right = near & (named == state)
    conflict = np.array([m.conflict for m in moments])
    crossing = np.array([m.crossing for m in moments])
    seen = np.stack([m.conflict_seen for m in moments])
    # The lowest threshold that is seldom wrong; where every moment has a conflict, none can be.
    false = seen[~conflict].mean(0) if not conflict.all() else np.zeros(len(THRESHOLDS))
    chosen = next((k for k in range(len(THRESHOLDS)) if false[k] <= FALSE_AT_MOST), len(THRESHOLDS) - 1)
    first = np.array([m.first for m in moments])
    first_seen = np.stack([m.first_seen for m in moments])[:, THRESHOLDS.index(0.5)]
    obstacle = (first >= 0) & (first * CELL_M < OBSTACLE_M)
    # A missed obstacle counts as the distance to the end of the range
    error_m = np.where(first_seen < 0, OBSTACLE_M - CELL_M * first, CELL_M * np.abs(first_seen - first))
    return {
        "light_accuracy_40m": _mean(named[near] == state[near]),
        "red_missed_40m": _mean(~stops[red]),
        "green_stopped_40m": _mean(stops[green]),
        "none_stopped": _mean(stops[none]),
        "light_error_m": _median(np.array([m.light_error_m for m in moments])[right]),
        "lights": float(near.sum()),
        "sign_recall_30m": _mean(np.abs(sign_seen_m[sign] - sign_m[sign]) < SIGN_ERROR_M),
        "sign_false": _mean(np.isfinite(sign_seen_m[np.isposinf(sign_m)])),
        "signs": float(sign.sum()),
        "conflict_recall": _mean(seen[conflict, chosen]),
        "conflict_false": float(false[chosen]),
        "crossing_recall": _mean(seen[conflict & crossing, chosen]),
        "threshold": THRESHOLDS[chosen],
        "conflicts": float(conflict.sum()),
        "crossings": float((conflict & crossing).sum()),
        "first_obstacle_error_m": _median(error_m[obstacle]),
        "first_obstacle_missed": _mean(first_seen[obstacle] < 0),
        "first_obstacle_false": _mean(first_seen[first < 0] >= 0),
        "frames": float(len(moments)),
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
