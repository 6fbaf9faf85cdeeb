"""A planner that scores speed profiles on the route by what is seen there.

Each profile is compared with the occupancy of the path over time and with the next light: how probably it
meets a road user, and when; whether it crosses the line of a light that stops it. A small network turns these
numbers into a score. It learns from the rule of `driving.speed_rule` on true perception, without images,
and then from the same rule on what is really seen.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.driving.dynamics import EGO
from foredrive.driving.speed_rule import DESIRED_MPS, TAIL_M
from foredrive.scene.affordances import CELL_M, CELLS, LATER_DT_S, TIMES, PathEstimate
from foredrive.scene.traffic_light import LightState

PROFILES = (
    (0.0, 8.0), (0.0, 6.0), (0.0, 4.5), (0.0, 3.0), (0.0, 2.0), (0.0, 1.2),
    (2.0, 2.0), (4.0, 3.0), (4.0, 1.5), (6.0, 1.5), (DESIRED_MPS, 0.0),
    (2.0, 1.0), (4.0, 1.2), (6.0, 1.5), (DESIRED_MPS, 1.5),
)  # fmt: skip
"""Speed profiles: the speed that each goes to, m/s, and how fast it changes, m/s². The first eleven brake to
it, or go on as fast as now (0); the others speed up to it."""
BRAKING = 11
TO_LIMIT_MPS2 = 2.0
"""Braking of a profile without any, where it is faster than the path allows, m/s²."""
MARGINS_M = (0.5, 2.5, 6.0)
"""Distances before the front bumper up to which a profile's way is looked at."""
NEAR_LINE_M = 3.0
SPEED_SCALE_MPS, DISTANCE_SCALE_M = 8.0, 20.0


@dataclass(frozen=True)
class SpeedPlannerConfig:
    """Sizes of a `SpeedPlanner`."""

    hidden: int = 64
    """Width of both hidden layers."""


def profile_progress(
    speed_mps: Float[Tensor, "b"], limit_mps: Float[Tensor, "b"], steps: int
) -> Float[Tensor, "b P T"]:
    """Return the distance driven by each profile at `steps` times `LATER_DT_S` apart, m.

    Args:
        speed_mps: at now.
        limit_mps: the highest speed that the path allows; no profile goes faster for longer than it takes to
            brake comfortably.
        steps: T.
    """
    t_s = LATER_DT_S * torch.arange(1, steps + 1, device=speed_mps.device)
    table = speed_mps.new_tensor(PROFILES)
    v = speed_mps[:, None]
    brakes = torch.arange(len(PROFILES), device=v.device) < BRAKING
    # Braking profiles never speed up, and the others never slow down, except for the limit
    target = torch.where(brakes, torch.minimum(table[:, 0], v), torch.maximum(table[:, 0], v))
    target = torch.minimum(target, limit_mps[:, None])
    # A profile that goes on as fast as now slows down to the limit all the same.
    rate = torch.where(table[:, 1] > 0, table[:, 1], TO_LIMIT_MPS2)
    # The speed changes at constant rate until the target, then stays
    changed_s = ((target - v).abs() / rate)[..., None]
    within_s = torch.minimum(t_s, changed_s)
    signed = torch.where(target < v, -rate, rate)[..., None]
    return v[..., None] * within_s + 0.5 * signed * within_s**2 + target[..., None] * (t_s - within_s)


class SpeedPlanner(nn.Module):
    """Scores the profiles of a path: the same small network reads the numbers of each.

    Args:
        config: sizes.
    """

    def __init__(self, config: SpeedPlannerConfig) -> None:
        super().__init__()
        times = TIMES - 1
        numbers = times * (len(MARGINS_M) + 3) + 4 + 3 + 3
        self.score = nn.Sequential(
            nn.Linear(numbers + len(PROFILES), config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, config.hidden),
            nn.ReLU(),
            nn.Linear(config.hidden, 1),
        )

    def forward(
        self, view: PathEstimate, speed_mps: Float[Tensor, "b"], limit_mps: Float[Tensor, "b"]
    ) -> Float[Tensor, "b P"]:
        """Return the logit of each profile.

        Args:
            view: what is on the path; probabilities, or the truth as 0 and 1.
            speed_mps, limit_mps: as of `profile_progress`.
        """
        return self.logits(profile_numbers(view, speed_mps, limit_mps))

    def logits(self, numbers: Float[Tensor, "b P N"]) -> Float[Tensor, "b P"]:
        """Return the logit of each profile from its `profile_numbers`."""
        which = torch.eye(len(PROFILES)).to(numbers).expand(len(numbers), -1, -1)
        scores: Tensor = self.score(torch.cat([numbers, which], dim=-1))
        return scores[..., 0]


def profile_numbers(
    view: PathEstimate, speed_mps: Float[Tensor, "b"], limit_mps: Float[Tensor, "b"]
) -> Float[Tensor, "b P N"]:
    """Return what a score depends on, for each profile.

    N numbers: at each time, how probably road users are met at each of `MARGINS_M` and half a second off, and
    where front and tail are to the line of a light that stops; then the light, the speed and the progress.
    """
    progress_m = profile_progress(speed_mps, limit_mps, TIMES - 1)  # [b P T]
    b, profiles, times = progress_m.shape
    # Cells are judged by their place before the front bumper
    start_m = CELL_M * torch.arange(CELLS).to(progress_m)
    occupied = view.occupied.to(progress_m)[:, None, 1:]  # [b 1 T G]
    ends_m = progress_m[..., None]
    # The vehicle reaches from its rear to a margin before its front: the most probable cell there counts.
    inside = start_m + CELL_M > ends_m - EGO.length_m
    met = [
        torch.where(inside & (start_m < ends_m + margin_m), occupied, 0.0).amax(-1) for margin_m in MARGINS_M
    ]
    # Who will be there half a second earlier or later: a road user is seldom exactly on time.
    sooner = torch.cat([occupied[:, :, 1:], occupied[:, :, -1:]], dim=2)
    before = view.occupied.to(progress_m)[:, None, :-1]
    loose = torch.maximum(occupied, torch.maximum(sooner, before))
    met.append(torch.where(inside & (start_m < ends_m + MARGINS_M[1]), loose, 0.0).amax(-1))
    # Probability that the light stops the vehicle
    stops = view.light[:, [LightState.RED, LightState.YELLOW]].sum(-1)
    # Within some metres of the line, the side on which the front and the judged point are.
    line_m = view.light_m[:, None, None]
    over = ((progress_m - line_m) / NEAR_LINE_M).clamp(-1, 1)
    tail_over = ((progress_m - line_m - TAIL_M) / NEAR_LINE_M).clamp(-1, 1)
    lit = (1 - view.light[:, LightState.NONE])[:, None, None]
    light = torch.cat(
        [
            view.light,
            stops[:, None],
            (view.light_m / DISTANCE_SCALE_M).clamp(-1, 2)[:, None],
            (speed_mps.square() / (2 * view.light_m.clamp_min(0.5)) / SPEED_SCALE_MPS).clamp_max(2)[:, None],
        ],
        dim=-1,
    )
    # Speed, limit and progress, as shares of a usual speed.
    own = torch.stack(
        [
            (speed_mps / SPEED_SCALE_MPS)[:, None].expand(b, profiles),
            (limit_mps / SPEED_SCALE_MPS)[:, None].expand(b, profiles),
            progress_m[..., -1] / (SPEED_SCALE_MPS * times * LATER_DT_S),
        ],
        dim=-1,
    )
    per_time = [*met, stops[:, None, None] * over * lit, lit * tail_over * stops[:, None, None]]
    return torch.cat([*per_time, light[:, None].expand(-1, profiles, -1), own], dim=-1)


def chosen_labels(
    progress_m: Float[Tensor, "b P T"], rule_m: Float[Tensor, "b T"], spread_m: float = 1.0
) -> Float[Tensor, "b P"]:
    """Return the probability of each profile that the planner learns: high where it drives as the rule does.

    Args:
        progress_m: of the profiles.
        rule_m: progress by the rule at the same times.
        spread_m: mean difference at which the probability falls to 1/√e of the best.
    """
    # Mean distance from the rule's progress; a second term keeps far profiles unlikely
    away_m = (progress_m - rule_m[:, None]).abs().mean(-1)
    return (-0.5 * ((away_m - away_m.amin(-1, keepdim=True)) / spread_m).square() - away_m).softmax(-1)
