"""Speed profiles by hand, and a planner that learns the rule from truth alone."""

import dataclasses

import numpy as np
import pytest
import torch
from path_truth import truth

from foredrive.driver.planner_fit import rule_of, true_estimate
from foredrive.driver.speed_planner import (
    BRAKING,
    PROFILES,
    SpeedPlanner,
    SpeedPlannerConfig,
    chosen_labels,
    profile_numbers,
    profile_progress,
)
from foredrive.driving.observation import HORIZON_STEPS
from foredrive.engine.in_memory_fit import FitSchedule, fit_in_memory
from foredrive.scene.affordances import CELLS, TIMES, Affordances, PathEstimate
from foredrive.scene.traffic_light import LightState


def test_profiles_are_kinematics_within_the_limit() -> None:
    progress_m = profile_progress(torch.tensor([6.0, 0.0, 8.0]), torch.tensor([8.0, 8.0, 4.0]), 4)
    brakes = PROFILES.index((0.0, 3.0))
    torch.testing.assert_close(progress_m[0, brakes], torch.tensor([2.625, 4.5, 5.625, 6.0]))
    keeps = BRAKING - 1
    torch.testing.assert_close(progress_m[0, keeps], 3.0 * torch.arange(1.0, 5.0))
    fastest = len(PROFILES) - 1
    torch.testing.assert_close(progress_m[1, fastest], 0.75 * (0.5 * torch.arange(1.0, 5.0)) ** 2)
    assert not progress_m[1, :BRAKING].any()
    # Before a curve of 4 m/s, whoever would not brake slows down with 2 m/s², or as the profile does.
    torch.testing.assert_close(progress_m[2, keeps, -1], torch.tensor(8 * 2 - 2.0**2))
    assert (progress_m.diff(dim=-1) >= -1e-6).all()


def test_the_numbers_tell_who_is_met_and_when() -> None:
    occupied = torch.zeros(1, TIMES, CELLS)
    occupied[0, 3, 4] = 0.7  # 8 to 10 m ahead after 1.5 s
    view = PathEstimate(torch.eye(4)[[0]], torch.zeros(1), occupied)
    numbers = profile_numbers(view, torch.tensor([6.0]), torch.tensor([8.0]))[0]
    times = TIMES - 1
    near, keeps = numbers[:, :times], BRAKING - 1
    assert near[keeps].tolist() == pytest.approx([0, 0, 0.7, 0, 0, 0, 0, 0])  # it is at 9 m then
    assert not near[PROFILES.index((0.0, 8.0))].any()  # it stands after 2.3 m
    loose = numbers[:, 3 * times : 4 * times]
    assert loose[keeps].tolist() == pytest.approx(
        [0, 0.7, 0.7, 0.7, 0, 0, 0, 0]
    )  # 6 m, and 12 with the rear at 7


def test_labels_prefer_the_profile_nearest_to_the_rule() -> None:
    progress_m = profile_progress(torch.tensor([6.0]), torch.tensor([8.0]), HORIZON_STEPS)
    for profile in (0, 4, 10, 14):
        labels = chosen_labels(progress_m, progress_m[:, profile])
        assert float(labels.sum()) == pytest.approx(1.0)
        # Profiles that speed up to less than the present speed keep it: they are the same.
        torch.testing.assert_close(progress_m[0, labels[0].argmax()], progress_m[0, profile])


def situations(count: int) -> Affordances:
    """Straight roads: a light at random distances, somebody who stands or crosses, or nothing."""
    draws = np.random.default_rng(0)
    base = truth(count)
    light = torch.from_numpy(draws.integers(0, 4, count))
    occupied = torch.zeros(count, TIMES, CELLS, dtype=torch.bool)
    for row in range(count):
        if draws.random() < 0.5:
            first = int(draws.integers(0, 6))
            occupied[row, first : first + int(draws.integers(3, 9)), int(draws.integers(2, 14))] = True
    path = torch.stack([torch.arange(72.0), torch.zeros(72)], -1)
    return dataclasses.replace(
        base,
        light=light,
        light_m=torch.from_numpy(draws.uniform(1, 40, count)).float(),
        occupied=occupied,
        path_xy=path.expand(count, -1, -1),
        path_valid=torch.ones(count, 72, dtype=torch.bool),
    )


def test_a_planner_learns_the_rule() -> None:
    """It stops at red lights and for people, and drives on where nothing is, much as the rule does."""
    known = situations(700)
    speed = torch.from_numpy(np.random.default_rng(1).uniform(0, 9, 700)).float()
    rules = [rule_of(known[row], float(speed[row])) for row in range(700)]
    rule_m, limit = torch.from_numpy(np.stack([rule for rule, _ in rules])).float(), torch.full((700,), 8.0)
    progress_m = profile_progress(speed, limit, HORIZON_STEPS)
    target = chosen_labels(progress_m, rule_m)
    numbers = profile_numbers(true_estimate(known), speed, limit)
    torch.manual_seed(0)
    planner = SpeedPlanner(SpeedPlannerConfig(hidden=32))

    def loss(rows: torch.Tensor) -> torch.Tensor:
        return -(target[rows] * planner.logits(numbers[rows]).log_softmax(-1)).sum(-1).mean()

    train = 600

    def error_m() -> torch.Tensor:
        with torch.no_grad():
            best = planner.logits(numbers).argmax(-1)
        return (progress_m[torch.arange(700), best] - rule_m).abs().mean(-1)[train:]

    before = float(error_m().mean())
    fit_in_memory(planner, train, loss, FitSchedule(600, 128, 3e-3, 1e-3), seed=0)
    assert float(error_m().mean()) < 0.35 * before
    red = (known.light == LightState.RED)[train:] & (known.light_m[train:] < 20) & (speed[train:] < 7)
    assert int(red.sum()) >= 5
    with torch.no_grad():
        best = planner.logits(numbers).argmax(-1)[train:]
    over = progress_m[train:][torch.arange(100), best, -1] > known.light_m[train:]
    assert float(over[red].float().mean()) < 0.2
