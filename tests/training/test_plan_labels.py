"""Sub-scores of plans, worked out by hand on a street with a car, a red light and an edge; and the scorer."""

import dataclasses

import pytest
import torch
from small_drives import one_example

from foredrive.errors import InputError
from foredrive.losses.plan_scores import soft_imitation_loss, sub_score_loss
from foredrive.models.plan_scorer import SUB_SCORES, ChoiceWeights, PlanScorer, PlanScorerConfig, ScoredPlans
from foredrive.models.plan_vocabulary import Candidates, VocabularyConfig, plan_vocabulary, turn_rates
from foredrive.models.planner import PlannerConfig, VolumePlanner
from foredrive.scene import Boxes, Category, Example, VoxelSpec
from foredrive.scene.affordances import CELLS, TIMES, Affordances
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.boxes import unlabelled
from foredrive.scene.map_elements import MapRaster, PlaneSpec, RasterLayer
from foredrive.scene.task_truth import TaskTruth
from foredrive.scene.traffic_light import LightState
from foredrive.training.plan_labels import plan_labels

STEPS, DT_S = 6, 0.5
RASTER = PlaneSpec((-20.0, -20.0), 0.5, (80, 160))
SPEED_MPS = 8.0


def straight(speeds: list[float], yaw: float = 0.0) -> Candidates:
    """Plans at constant speeds along one heading."""
    t_s = DT_S * torch.arange(1, STEPS + 1)
    along = torch.tensor(speeds)[:, None] * t_s
    heading = torch.tensor([torch.cos(torch.tensor(yaw)), torch.sin(torch.tensor(yaw))])
    xy = along[..., None] * heading
    speed = torch.tensor(speeds)[:, None].expand(-1, STEPS)
    return Candidates(xy[None], torch.full_like(xy[None, ..., 0], yaw), speed[None].contiguous())


def street(
    light: int = LightState.NONE,
    later: list[int] | None = None,
    light_m: float = 10.0,
    car_x: float = 100.0,
    car_mps: float = 0.0,
    expert_mps: float = SPEED_MPS,
    known: bool = True,
) -> Example:
    """The route runs along x, 7 m of it are drivable on either side; a car is ahead or behind."""
    example = one_example(0)
    clip = example.clip
    frames = clip.t_s.shape[1]
    shape = (1, frames, 1)
    boxes = Boxes(
        centre=torch.tensor([car_x, 0.0, 1.0]).expand(*shape, 3),
        size_lwh=torch.tensor([4.0, 2.0, 1.6]).expand(*shape, 3),
        yaw=torch.zeros(shape),
        velocity=torch.zeros(*shape, 2),
        track_id=torch.ones(shape, dtype=torch.long),
        category=torch.full(shape, int(Category.CAR)),
        valid=torch.ones(shape, dtype=torch.bool),
        **unlabelled(*shape),
    )
    t_s = DT_S * torch.arange(1, 13)
    xy = torch.stack([car_x + car_mps * t_s, torch.zeros(12)], -1)[None, None]
    there = torch.ones(1, 1, 12, dtype=torch.bool)
    layers = torch.zeros(1, 4, *RASTER.shape_yx, dtype=torch.bool)
    layers[:, RasterLayer.DRIVABLE, 26:54] = True  # y from -7 to 7
    yes = torch.tensor([known])
    states = [light] * STEPS if later is None else later
    road = Affordances(
        path_xy=torch.stack([torch.arange(60.0), torch.zeros(60)], -1)[None],
        path_valid=torch.ones(1, 60, dtype=torch.bool),
        light=torch.tensor([int(light)]),
        light_m=torch.tensor([light_m]),
        light_known=yes,
        light_later=torch.tensor([[int(state) for state in states]]),
        lamp_xyz=torch.zeros(1, 0, 3),
        lamp=torch.zeros(1, 0, dtype=torch.bool),
        lamps_known=torch.tensor([False]),
        lead=torch.tensor([False]),
        lead_m=torch.zeros(1),
        lead_mps=torch.zeros(1),
        lead_known=yes,
        crossing_xy=torch.zeros(1, 0, 2),
        crossing=torch.zeros(1, 0, dtype=torch.bool),
        crossing_known=yes,
        occupied=torch.zeros(1, TIMES, CELLS, dtype=torch.bool),
        occupied_known=torch.ones(1, TIMES, CELLS, dtype=torch.bool),
    )
    driven = straight([expert_mps])
    future = dataclasses.replace(
        clip.future,
        xy=driven.xy,
        yaw=driven.yaw,
        valid=torch.ones(1, 1, STEPS, dtype=torch.bool),
    )
    clip = dataclasses.replace(
        clip,
        boxes=boxes,
        boxes_valid=torch.ones(1, frames, dtype=torch.bool),
        future=future,
        ego_speed_mps=torch.full_like(clip.ego_speed_mps, SPEED_MPS),
    )
    truth = TaskTruth(
        futures=AgentFutures(xy, torch.zeros(1, 1, 12), there, DT_S),
        raster=MapRaster(RASTER, layers, yes),
        affordances=road,
    )
    return dataclasses.replace(example, clip=clip, truth=truth)


def labels(plans: Candidates, example: Example) -> dict[str, list[float]]:
    found = plan_labels(plans, example, DT_S)
    return {name: found.values[0, :, k].tolist() for k, name in enumerate(SUB_SCORES)}


def test_a_plan_into_a_standing_car_collides_and_the_slower_one_comes_too_close() -> None:
    """The car's rear is at 18 m, our front at 4.1 m: 4 m/s leave 1.9 m after 3 s, 8 m/s do not."""
    found = labels(straight([0.0, 2.0, 4.0, 8.0]), street(car_x=20.0))
    assert found["no_collision"] == [1, 1, 1, 0]
    assert found["time_to_collision"] == [1, 1, 0, 0]


def test_who_is_hit_from_behind_or_stands_is_not_at_fault() -> None:
    """A car from behind at 12 m/s runs into us; we stand, or are slower."""
    found = labels(straight([0.0, 2.0]), street(car_x=-9.0, car_mps=12.0))
    assert found["no_collision"][0] == 1
    into_us = labels(straight([0.0]), street(car_x=20.0, car_mps=-12.0))
    assert into_us["no_collision"] == [1]
    ahead = labels(straight([2.0]), street(car_x=20.0, car_mps=-12.0))
    assert ahead["no_collision"] == [0]


def test_a_red_light_may_not_be_crossed_until_it_is_green() -> None:
    """The line is 10 m ahead of the bumper, where `light_m` counts from."""
    red, green = LightState.RED, LightState.GREEN
    plans = straight([0.0, 3.0, 8.0])
    assert labels(plans, street(red))["light"] == [1, 1, 0]
    assert labels(plans, street(red, later=[red, red, green, green, green, green]))["light"] == [1, 1, 1]
    assert labels(plans, street(green, later=[green, red, red, red, red, red]))["light"] == [1, 1, 0]
    assert labels(plans, street())["light"] == [1, 1, 1]
    beyond = street(red, light_m=-1.0)
    assert labels(plans, beyond)["light"] == [1, 1, 1]


def test_progress_is_relative_to_the_expert() -> None:
    assert labels(straight([0.0, 4.0, 16.0]), street())["progress"] == pytest.approx([0.0, 0.5, 1.0])
    assert labels(straight([0.0, 4.0]), street(expert_mps=0.0))["progress"] == [1, 1]


def test_lane_road_and_comfort() -> None:
    """At 0.3 rad and 8 m/s, half a metre is left after 0.5 s and 7 m after 3 s."""
    aside = straight([8.0], yaw=0.3)
    found = labels(
        Candidates(*(torch.cat(each, 1) for each in zip(straight([8.0]), aside, strict=True))), street()
    )
    assert found["lane"] == [1, 0]
    assert found["drivable"] == [1, 0]
    braking = straight([8.0, 5.0])
    assert labels(braking, street())["comfort"] == [1, 0]  # -6 m/s² in the first half second


def test_what_a_log_does_not_tell_is_masked() -> None:
    example = street(known=False)
    found = plan_labels(straight([1.0]), example, DT_S)
    known = dict(zip(SUB_SCORES, found.known[0].tolist(), strict=True))
    assert not known["light"]
    assert not known["drivable"]
    assert known["no_collision"]
    with pytest.raises(InputError, match="plans are scored by"):
        plan_labels(straight([1.0]), dataclasses.replace(example, truth=None), DT_S)
    with pytest.raises(InputError, match="steps of"):
        plan_labels(straight([1.0]), example, 0.25)


def with_futures(example: Example, valid: list[bool]) -> Example:
    """The same street, whose car is observed at some steps only."""
    assert example.truth is not None
    assert example.truth.futures is not None
    there = torch.tensor(valid)[None, None]
    futures = dataclasses.replace(
        example.truth.futures, xy=example.truth.futures.xy * there[..., None], valid=there
    )
    return dataclasses.replace(example, truth=dataclasses.replace(example.truth, futures=futures))


def test_collisions_after_the_end_of_a_log_are_unknown() -> None:
    """An expert's plan is longer than the rest of the log, in which nobody hits the car 20 m ahead."""
    ends = with_futures(street(car_x=20.0), [True] * 2 + [False] * 10)
    found = plan_labels(straight([8.0]), ends, DT_S)
    known = dict(zip(SUB_SCORES, found.known[0].tolist(), strict=True))
    assert not known["no_collision"]
    assert not known["time_to_collision"]
    assert known["comfort"]
    boxes = dataclasses.replace(ends.clip.boxes, valid=torch.zeros_like(ends.clip.boxes.valid))
    empty = dataclasses.replace(ends, clip=dataclasses.replace(ends.clip, boxes=boxes))
    assert bool(plan_labels(straight([8.0]), empty, DT_S).known[0, SUB_SCORES.index("no_collision")])


def test_the_vocabulary_reaches_the_target_at_all_speeds() -> None:
    config = VocabularyConfig()
    target = torch.tensor([[18.0, 8.0, 1.0], [20.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
    speed = torch.tensor([8.0, 0.0, 5.0, 5.0])
    plans = plan_vocabulary(config, speed, target, STEPS, DT_S)
    assert plans.xy.shape == (4, config.size, STEPS, 2)
    assert plans.xy.isfinite().all()
    away = (plans.xy[0] - target[0, :2]).norm(dim=-1).amin()
    assert away < 2.0
    stops = plans.speed_mps[..., -1] == 0
    assert (stops.sum(-1) >= 21).all()
    steps = plans.xy.diff(dim=2, prepend=torch.zeros_like(plans.xy[:, :, :1])).norm(dim=-1)
    driven = steps.sum(-1)
    assert driven.max() < 3 * 13.1
    first = speed[:, None] * DT_S
    assert (steps[..., 0] <= first + 0.5 * 4 * DT_S**2 + 1e-3).all()
    assert plans.yaw[2].abs().min() < 1e-3  # straight ahead is among them
    gentle = turn_rates(plans, DT_S)[1].abs().amax(-1)
    assert (gentle < 1.0).float().mean() > 0.9


def scored(logits: torch.Tensor, imitation: torch.Tensor) -> ScoredPlans:
    n = logits.shape[1]
    xy = torch.arange(float(n))[None, :, None, None].expand(len(logits), n, STEPS, 2)
    return ScoredPlans(xy, xy[..., 0], xy[..., 0], logits, imitation, DT_S, ChoiceWeights())


def test_the_choice_avoids_collisions_before_it_follows_the_expert() -> None:
    logits = torch.full((2, 3, len(SUB_SCORES)), 4.0)
    logits[:, 0, SUB_SCORES.index("no_collision")] = -4.0
    logits[1, 1, SUB_SCORES.index("progress")] = -4.0
    imitation = torch.tensor([[3.0, 1.0, 0.0], [3.0, 1.0, 0.0]])
    best = scored(logits, imitation).best()
    assert best.xy[:, 0, 0, 0].tolist() == [1.0, 2.0]
    assert best.valid.all()


def test_the_losses_are_least_for_the_truth() -> None:
    values = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    sure, known = 9.0 * (2 * values - 1), torch.tensor([[True, False]])
    assert sub_score_loss(sure, values, known)[0] < 1e-3 < sub_score_loss(-sure, values, known)[0]
    assert sub_score_loss(-sure, values, known)[1] == 0
    xy = torch.tensor([[[[0.0, 0.0]], [[3.0, 0.0]]]])
    expert, there = torch.tensor([[[3.0, 0.0]]]), torch.tensor([[True]])
    right = soft_imitation_loss(torch.tensor([[0.0, 9.0]]), xy, expert, there)
    assert right < 0.01 < soft_imitation_loss(torch.tensor([[9.0, 0.0]]), xy, expert, there)


def test_a_scorer_learns_to_stop_at_a_light_that_it_is_told() -> None:
    """One token tells red or green. After some steps, the chosen plan crosses only in green."""
    spec = VoxelSpec(lower_m=(-4.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(1, 8, 16))
    torch.manual_seed(0)
    config = PlanScorerConfig(
        vocabulary=VocabularyConfig(lateral_m=(0.0,), bend_rad=(0.0,), speeds=((0.0, 4.0), (8.0, 2.0)))
    )
    model = PlanScorer(config, spec, width=16, heads=2, feed_forward=16, dropout=0.0, steps=STEPS)
    target = torch.tensor([[20.0, 0.0, 1.0]]).expand(2, 3)
    plans = plan_vocabulary(config.vocabulary, torch.full((2,), SPEED_MPS), target, STEPS, DT_S)
    both = [street(LightState.RED, expert_mps=0.5), street(LightState.GREEN)]
    truth = torch.cat(
        [
            plan_labels(Candidates(*(e[k : k + 1] for e in plans)), each, DT_S).values
            for k, each in enumerate(both)
        ]
    )
    plane, query = torch.zeros(2, 8, 16, 16), torch.zeros(2, 16)
    tokens = torch.stack([torch.ones(16), -torch.ones(16)])[:, None]
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(60):
        logits = model(plans, query, plane, tokens)
        loss = sub_score_loss(logits[..., :-1], truth, torch.ones(2, len(SUB_SCORES), dtype=torch.bool)).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    out = ScoredPlans(*plans, logits[..., :-1].detach(), 0 * logits[..., -1].detach(), DT_S, config.choice)
    end_m = out.best().xy[:, 0, -1, 0]
    assert end_m[0] < 10.0 < end_m[1]


def test_a_scoring_planner_needs_a_target_and_nothing_to_correct() -> None:
    spec = VoxelSpec(lower_m=(-4.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(1, 8, 16))
    sizes = PlannerConfig(
        width=16, layers=1, heads=2, pool=(1, 2, 2), scorer=PlanScorerConfig(), future="none"
    )
    with pytest.raises(InputError, match=r"set planner\.target to true"):
        VolumePlanner(sizes, spec, channels=3, horizon_steps=STEPS, dt_s=DT_S)
    planner = VolumePlanner(
        dataclasses.replace(sizes, target=True), spec, channels=3, horizon_steps=STEPS, dt_s=DT_S
    ).eval()
    plan = planner(
        torch.randn(2, 3, *spec.shape_zyx),
        None,
        torch.tensor([0, 2]),
        torch.tensor([True, False]),
        torch.tensor([5.0, 0.0]),
        torch.tensor([True, True]),
        torch.zeros(2, 0, 4),
        torch.tensor([[15.0, 5.0, 1.0], [0.0, 0.0, 0.0]]),
    )
    assert plan.xy.shape == (2, 1, STEPS, 2)
