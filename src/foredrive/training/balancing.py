"""Balanced sampling of demonstrations: how often each is drawn, by what the plan to learn does."""

import enum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

STANDS_MPS = 0.5
BRAKES, SPEEDS_UP = 0.6, 1.5
"""Quotients of the last and the present speed below and above which a plan brakes or speeds up."""
TURNS_M = 2.0
"""Lateral offset of a turn, m."""


class Manoeuvre(enum.IntEnum):
    """What a plan does. The first that holds counts."""

    WAITS = 0
    STARTS = 1
    STOPS = 2
    """It ends below walking pace: at a light, behind a vehicle, before a person."""
    BRAKES = 3
    TURNS = 4
    SPEEDS_UP = 5
    CRUISES = 6


def manoeuvres(
    speed_mps: Float[Tensor, "N"], xy: Float[Tensor, "N T 2"], valid: Bool[Tensor, "N T"], dt_s: float
) -> Int[Tensor, "N"]:
    """Return the `Manoeuvre` of each plan. One without a valid step cruises.

    Args:
        speed_mps: present speed.
        xy: waypoints in the ego frame, m.
        valid: which of them exist.
        dt_s: time of a step.
    """
    steps = xy.diff(dim=1, prepend=torch.zeros_like(xy[:, :1])).norm(dim=-1) / dt_s
    last = (valid.long() * torch.arange(1, valid.shape[1] + 1)).argmax(dim=1)
    rows = torch.arange(len(xy))
    end_mps, aside_m = steps[rows, last], xy[rows, last, 1].abs()
    standing, ends_still = speed_mps < STANDS_MPS, end_mps < STANDS_MPS
    cases = [
        (Manoeuvre.SPEEDS_UP, end_mps > SPEEDS_UP * speed_mps),
        (Manoeuvre.TURNS, aside_m > TURNS_M),
        (Manoeuvre.BRAKES, end_mps < BRAKES * speed_mps),
        (Manoeuvre.STOPS, ends_still),
        (Manoeuvre.STARTS, standing),
        (Manoeuvre.WAITS, standing & ends_still),
    ]
    found = torch.full_like(rows, Manoeuvre.CRUISES)
    for kind, holds in cases:
        found = torch.where(holds & valid.any(dim=1), int(kind), found)
    return found


def balanced_weights(kind: Int[Tensor, "N"], power: float) -> Float[Tensor, "N"]:
    """Return how often to draw each item relative to the others, of mean 1.

    A kind with n items is drawn in proportion to n^(1 - power): with 0 as often as it occurs, with 1 as often
    as any other kind.
    """
    count = torch.bincount(kind).double()
    weight = count[kind] ** -power
    return (weight / weight.mean()).float()
