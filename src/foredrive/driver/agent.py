"""A driver in closed loop: its eyes, its planner, and what it remembers from plan to plan."""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.interpolate import PchipInterpolator
from torch import Tensor, nn

from foredrive.data.truth.affordances import PASSED_M, POINTS, PathAhead
from foredrive.driver.eyes import CameraEyes
from foredrive.driver.sight import Sight
from foredrive.driver.speed_planner import SpeedPlanner, profile_progress
from foredrive.driver.volume_eyes import VolumeEyes
from foredrive.driving.observation import HORIZON_STEPS
from foredrive.driving.simple_agents import plan_of
from foredrive.driving.speed_rule import FRONT_M, curve_speed, waypoints_along
from foredrive.driving.stop_signs import StopSigns
from foredrive.methods.planner.ego_mlp import ego_speeds
from foredrive.scene import Clip, Trajectory
from foredrive.scene.affordances import PathEstimate
from foredrive.scene.clip import ROUTE_M
from foredrive.scene.traffic_light import LightState

SEEN, CLEAR = 0.5, 1.1
"""Probability of a lamp, and odds (logit, 3 to 1) of stop or go, from which the light of a frame counts."""
FADES, LONGEST, DOUBT = 0.5, 5.0, 0.2
"""Share of the evidence for a stop that is kept from plan to plan, its bound (logit), and the evidence below
which a light that is not seen is forgotten."""
WEAK, WEAKLY, BEYOND_M = 2.0, 0.9, 1.0
"""Evidence below which a light at its line is waited for only for a while, the share of it that is kept from
plan to plan, and the distance beyond the line from which that holds for each light: its lamps are in view."""
NEAR_M = 7.0
"""Distance before its line within which a light that is not seen is remembered."""
OTHER_M, SEEN_OTHER_M, CONFIRMED = 12.0, 4.0, 3
"""Differences from the remembered distance by which a reading is of another light: of a line read at its
lamps, and of one that is seen itself. A nearer light is the next one at once, a farther one after so many
readings in a row."""
NEARER, FARTHER, SEEN_SHARE = 0.5, 0.15, 0.5
"""Shares by which readings of the same line move it: at lamps nearer or farther than remembered, and on the
ground."""
BEFORE_LINE_M = 2.5
"""Distance before the line at which the vehicle stops: at the line half of the lamps are out of view."""
FORGETS, STILL_M = 30, 0.02
"""Plans without a lamp after which a light is forgotten; those over which the vehicle has moved less do not
count."""
AHEAD_M, HELD_M = 2.0, 4.0
"""Least distance at which a line becomes the next one, unless the drive begins at it; and the distance from
which a line that was seen need not be seen any more."""
STANDS_MPS = 0.2
WAITS, CREEPS, IMPATIENT = 10, 8, 70
"""Plans that the vehicle stands without a red light before it creeps, for which it creeps, and after which it
creeps in spite of a light: it is seen wrongly, or no light at all."""
NEAR_CELLS, STAYS = 3, 3
"""Cells of the route next to the vehicle; who is in them now is taken to stay for so many steps of half a
second. Who stands close ahead is often expected to leave."""
SIGN_READINGS, PROBABLE = 2, 0.5
"""Readings of a stop sign's line from which it counts, and the probability of those it gives way to there."""
SURE = 0.93
"""While it creeps, only road users that are as probable as this stop it."""


class Driver(nn.Module):
    """Eyes and a planner.

    Args:
        eyes: what sees the route.
        planner: what scores speeds.
    """

    def __init__(self, eyes: CameraEyes | VolumeEyes, planner: SpeedPlanner) -> None:
        super().__init__()
        self.eyes, self.planner = eyes, planner

    @torch.no_grad()
    def see(self, clip: Clip) -> Sight:
        """Return what is seen at now, on the clip's device. The eyes may be on another one."""
        sight: Sight = self.eyes(clip.to(next(self.eyes.parameters()).device))
        return sight.to(clip.t_s.device)


class LightMemory:
    """Remembers what was seen of the next light: near its line, its lamps are out of view."""

    def __init__(self) -> None:
        self._evidence = 0.0
        """Logarithm of the odds that the light stops the vehicle."""
        self._line_m: float | None = None
        self._unseen, self._farther, self._yellow = 0, 0, False
        self._was_seen, self._has_moved = False, False

    def update(self, view: PathEstimate, moved_m: float, *, line_seen: bool = False) -> PathEstimate:
        """Return the view with the light that is seen or remembered.

        Args:
            view: of a batch of one.
            moved_m: distance driven since the plan before.
            line_seen: whether the distance of the line is of the line itself, and not of its lamps.
        """
        p, line_m = view.light[0].tolist(), float(view.light_m[0])
        # The remembered line comes nearer by the distance driven
        if self._line_m is not None:
            self._line_m -= moved_m
        stops = p[LightState.RED] + p[LightState.YELLOW]
        # What is seen beyond the line of a green light are the lamps of somebody else
        is_through = self._line_m is not None and self._line_m < 0 and self._evidence < 0
        # A new line is seen from afar: one that is read at the bumper has just been crossed
        self._has_moved = self._has_moved or moved_m > STILL_M
        is_behind = self._line_m is None and line_m < AHEAD_M and self._has_moved
        # Odds given that there is a light: the probability of NONE is no evidence for green
        odds = float(np.log((stops + 0.02) / (p[LightState.GREEN] + 0.02)))
        is_clear = 1 - p[LightState.NONE] > SEEN and abs(odds) > CLEAR
        if is_clear and not (is_through or is_behind):
            self._evidence = float(np.clip(FADES * self._evidence + odds, -LONGEST, LONGEST))
            self._unseen, self._yellow = 0, p[LightState.YELLOW] > p[LightState.RED]
            self._move_line(line_m, line_seen)
        else:
            # Unseen plans count only while the vehicle moves
            self._unseen += moved_m > STILL_M  # a standing vehicle waits for the light
            self._evidence *= self._kept(line_m, line_seen)
            if abs(self._evidence) < DOUBT:
                self.forget()
        if self._unseen > FORGETS or (self._line_m is not None and self._line_m < -PASSED_M):
            self.forget()
        if self._line_m is None:
            light = torch.eye(4)[LightState.NONE]
            return PathEstimate(light[None].to(view.light), torch.zeros_like(view.light_m), view.occupied)
        # Evidence as a probability; the part that stops goes to the colour seen last
        stop = 1 / (1 + float(np.exp(-self._evidence)))
        light = torch.zeros(4)
        light[LightState.YELLOW if self._yellow else LightState.RED] = stop
        light[LightState.GREEN] = 1 - stop
        # Beyond the line the true distance counts: a red light holds until the judged point has crossed.
        stop_m = max(self._line_m - BEFORE_LINE_M, min(self._line_m, 0.0))
        return PathEstimate(light[None].to(view.light), torch.full_like(view.light_m, stop_m), view.occupied)

    def _kept(self, line_m: float, line_seen: bool) -> float:
        """Return the share of the evidence that is kept of a light that is not seen."""
        if self._line_m is None or not -PASSED_M < self._line_m < NEAR_M:
            return FADES
        # A line that is in view must be seen in its place
        is_confirmed = line_seen and abs(line_m - self._line_m) < SEEN_OTHER_M
        if not is_confirmed and self._line_m >= (HELD_M if self._was_seen else AHEAD_M):
            return FADES
        # Who stands for a light hardly seen, or far beyond its line, would wait until it is impatient
        return WEAKLY if abs(self._evidence) < WEAK or self._line_m < -BEYOND_M else 1.0

    def _move_line(self, line_m: float, line_seen: bool) -> None:
        """Take in a reading of the distance of the line."""
        # Lamps tell roughly where a line is, so they move none that has been seen itself
        if self._was_seen and not line_seen:
            return
        beyond_m = 0.0 if self._line_m is None else line_m - self._line_m
        other_m = SEEN_OTHER_M if self._was_seen else OTHER_M
        # A much farther line must be confirmed several times
        self._farther = self._farther + 1 if beyond_m > other_m else 0
        is_first = self._line_m is None or (line_seen and not self._was_seen)
        if is_first or beyond_m < -other_m or self._farther >= CONFIRMED:
            self._line_m, self._farther, self._was_seen = line_m, 0, line_seen
        elif self._farther == 0 and self._line_m is not None:
            # Lamps are read too far away more often than too near, and to stop too early costs less
            share = SEEN_SHARE if line_seen else NEARER if beyond_m < 0 else FARTHER
            self._line_m += share * beyond_m

    def forget(self) -> None:
        """Forget the light."""
        self._evidence, self._line_m, self._unseen, self._farther = 0.0, None, 0, 0
        self._was_seen = False


class Perception:
    """Returns what a driver knows of its route in one drive, by its sight and its memory.

    It remembers lights, and for how long it has stood.

    Args:
        driver: eyes and planner.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver, self._lights, self._signs = driver, LightMemory(), StopSigns(confirmed=SIGN_READINGS)
        self._before: Tensor | None = None
        self._stood, self._creeping, self._impatient = 0, 0, False

    def __call__(self, observation: Clip) -> PathEstimate:
        """Return what is on the route of an observation of a batch of one."""
        sight = self._driver.see(observation)
        view, line_seen = sight.estimate(), bool(sight.line_seen[0])
        here = observation.T_world_ego[0, observation.now, :3, 3]
        moved_m = 0.0 if self._before is None else float((here - self._before).norm())
        self._before = here
        view = self._lights.update(view, moved_m, line_seen=line_seen)
        view = PathEstimate(view.light, view.light_m, staying(view.occupied))
        speed_mps, sign_m = float(ego_speeds(observation)[0, observation.now]), float(sight.sign_m[0])
        occupied = (view.occupied[0] > PROBABLE).cpu().numpy()
        stop_m = self._signs.update(sign_m if np.isfinite(sign_m) else None, moved_m, speed_mps, occupied)
        return stopped_by_sign(self._patient(view, speed_mps), stop_m)

    def _patient(self, view: PathEstimate, speed_mps: float) -> PathEstimate:
        """Return the view with less on the route where the vehicle has stood for long."""
        # Long standing without a red light, or very long standing with one, starts a phase of creeping
        self._stood = self._stood + 1 if speed_mps < STANDS_MPS else 0
        stopped_by_light = float(view.light[0, [LightState.RED, LightState.YELLOW]].sum()) > 0.5
        if (self._stood > WAITS and not stopped_by_light) or self._stood > IMPATIENT:
            self._creeping, self._impatient = CREEPS, self._stood > IMPATIENT
        if self._creeping == 0:
            return view
        self._creeping -= 1
        # Impatient: the light is ignored. In any case only very probable road users stop the vehicle
        light = torch.eye(4)[[LightState.NONE]].to(view.light) if self._impatient else view.light
        return PathEstimate(light, view.light_m, (view.occupied > SURE).to(view.occupied))


def stopped_by_sign(view: PathEstimate, line_m: float | None) -> PathEstimate:
    """Return the view of a batch of one with a red light at the line of a stop sign, if that comes first."""
    stops = float(view.light[0, [LightState.RED, LightState.YELLOW]].sum()) > 0.5
    if line_m is None or (stops and float(view.light_m[0]) < line_m):
        return view
    light = torch.eye(4)[[LightState.RED]].to(view.light)
    return PathEstimate(light, torch.full_like(view.light_m, max(line_m - BEFORE_LINE_M, 0.0)), view.occupied)


def staying(occupied: Float[Tensor, "b T S"]) -> Float[Tensor, "b T S"]:
    """Return the occupancy of the path if those who are close ahead now stay for a while."""
    later = occupied.clone()
    now = occupied[:, :1, :NEAR_CELLS]
    later[:, 1 : 1 + STAYS, :NEAR_CELLS] = torch.maximum(later[:, 1 : 1 + STAYS, :NEAR_CELLS], now)
    return later


class SightDriver:
    """An `Agent` of one drive that scores speeds by what its driver sees.

    Args:
        driver: eyes and planner.
        perceive: returns what is on the route of an observation of a batch of one, in place of the eyes.
    """

    def __init__(self, driver: Driver, perceive: Callable[[Clip], PathEstimate] | None = None) -> None:
        self._planner, self._perceive = driver.planner, perceive or Perception(driver)
        self.sight: PathEstimate | None = None
        """Estimate that the last plan was made from."""

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """Return the plan for an observation of a batch of one. Without a route it goes straight on."""
        view = self.sight = self._perceive(observation)
        path = given_path(observation)
        speed = ego_speeds(observation)[:, observation.now]
        # The best speed profile on the route, then points along it
        limit = torch.full_like(speed, curve_speed(path))
        best = int(self._planner(view, speed, limit)[0].argmax())
        progress_m = profile_progress(speed, limit, HORIZON_STEPS)[0, best].double().cpu().numpy()
        return plan_of(torch.from_numpy(waypoints_along(path, progress_m)).float()[None, None])


class PartlyTrue:
    """Perception of which a part is replaced by the truth, to see what each part costs.

    Args:
        seen: perception by sight.
        true: perception of the truth.
        lights: whether lights are true.
        users: whether road users are true.
    """

    def __init__(
        self,
        seen: Callable[[Clip], PathEstimate],
        true: Callable[[Clip], PathEstimate],
        *,
        lights: bool,
        users: bool,
    ) -> None:
        self._seen, self._true, self._lights, self._users = seen, true, lights, users

    def __call__(self, observation: Clip) -> PathEstimate:
        """Return what is on the route of an observation of a batch of one."""
        true = self._true(observation)
        if self._lights and self._users:
            return true
        seen = self._seen(observation)
        light = true if self._lights else seen
        return PathEstimate(light.light, light.light_m, (true if self._users else seen).occupied)


def given_path(observation: Clip) -> PathAhead:
    """Return the route of an observation as a smooth path, a point a metre; straight ahead without one."""
    valid = observation.route_valid[0].cpu().numpy()
    along_m = np.array(ROUTE_M)[valid]
    xy = observation.route_xy[0].double().cpu().numpy()[valid]
    if len(along_m) < 2:
        along_m, xy = np.array([2.0, 40.0]), np.array([[2.0, 0.0], [40.0, 0.0]])
    # The point beside the vehicle: the route does not tell it, and the vehicle may be aside.
    step = (xy[1] - xy[0]) / (along_m[1] - along_m[0])
    xy = np.concatenate([(xy[0] - along_m[0] * step)[None], xy])
    along_m = np.append(0.0, along_m)
    # A smooth curve through the route's points, at steps of a metre
    last_m = int(along_m[-1])
    line = PchipInterpolator(along_m, xy)(np.arange(last_m + 1.0))
    return _on_grid(line)


def _on_grid(line: Float64[np.ndarray, "K 2"]) -> PathAhead:
    count = min(len(line), POINTS)
    xy: Float[Tensor, "R 2"] = torch.zeros(POINTS, 2)
    xy[:count] = torch.from_numpy(line[:count]).float()
    valid = torch.arange(POINTS) < count
    return PathAhead(xy, np.zeros(POINTS), valid, FRONT_M, True)
