"""DriveWorld's objective: what it looks at, and that descending it works."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from miniature import miniature_driveworld

from foredrive.methods.driveworld import motion_of
from foredrive.methods.driveworld.objective import DriveWorldObjective, nearest_velocities
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.runs.build import build_agent
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Example

RECIPE = miniature_driveworld()
SPEC = RECIPE.clips.voxels
PAST, STEPS = RECIPE.clips.past_frames, RECIPE.clips.future_frames
PRETRAINING, PLANNING = RECIPE.pretrain, RECIPE.finetune


def agent() -> PlanningAgent:
    torch.manual_seed(0)
    return build_agent(RECIPE)


def gradients(objective: DriveWorldObjective, example: Example) -> dict[str, bool]:
    """Of every parameter of the agent, whether a gradient reaches it."""
    objective(example, torch.Generator().manual_seed(0))["loss"].backward()
    found = objective.agent.named_parameters()
    return {name: p.grad is not None for name, p in found}


@pytest.fixture
def example(make_example: Callable[..., Example]) -> Example:
    """Everybody drives straight on at 4 m/s; one box of three moves."""
    example = make_example(past=PAST, future=STEPS, spec=SPEC)
    step = motion_of(torch.tensor([[4.0, 0.0]]), 0.5)[0].double()
    poses = [torch.eye(4, dtype=torch.float64)]
    for _ in range(PAST + STEPS):
        poses.append(poses[-1] @ step)
    clip = example.clip
    velocity = clip.boxes.velocity.clone()
    velocity[:, :, 1] = torch.tensor([3.0, -1.0])
    boxes = dataclasses.replace(clip.boxes, velocity=velocity)
    T = torch.stack(poses).expand(2, -1, -1, -1)
    return dataclasses.replace(example, clip=dataclasses.replace(clip, T_world_ego=T, boxes=boxes))


def test_descending_it_lowers_every_term_but_the_divergence(example: Example) -> None:
    objective = DriveWorldObjective(agent(), PRETRAINING, steps=STEPS)
    optimizer = torch.optim.Adam(objective.parameters(), 5e-3)
    seen = []
    for step in range(30):
        losses = objective(example, torch.Generator().manual_seed(step))
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
        seen.append({name: float(value.detach()) for name, value in losses.items()})
    first, last = seen[0], seen[-1]
    assert last["loss"] < 0.9 * first["loss"]
    for name in ("occ", "action", "velocity"):
        assert last[name] < first[name]
    weights = PRETRAINING.weights
    assert first["loss"] == pytest.approx(
        sum(getattr(weights, name) * value for name, value in first.items() if name != "loss"), rel=1e-5
    )


def test_what_is_not_known_counts_for_nothing(example: Example) -> None:
    nothing = dataclasses.replace(
        example,
        occupancy=dataclasses.replace(example.occupancy, known=torch.zeros_like(example.occupancy.known)),
        flow=dataclasses.replace(example.flow, known=torch.zeros_like(example.flow.known)),
        clip=dataclasses.replace(example.clip, boxes_valid=torch.zeros_like(example.clip.boxes_valid)),
    )
    losses = DriveWorldObjective(agent(), PRETRAINING, steps=STEPS)(nothing, torch.Generator().manual_seed(0))
    assert [losses[name].item() for name in ("occ", "velocity", "flow")] == [0.0, 0.0, 0.0]
    assert losses["loss"].isfinite()


def test_the_nearest_that_move_come_first(example: Example) -> None:
    boxes = example.clip.boxes
    centre = torch.tensor([[9.0, 0.0, 0.0], [5.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]).expand_as(boxes.centre)
    velocity = torch.tensor([[1.0, 0.0], [2.0, 0.0], [0.1, 0.0]]).expand_as(boxes.velocity)
    found, there = nearest_velocities(
        dataclasses.replace(boxes, centre=centre, velocity=velocity), 4, moving_mps=0.5
    )
    assert found[0, 0, :2, 0].tolist() == [2.0, 1.0]
    assert there[0, 0].tolist() == [True, True, False, False]
    unmoved = dataclasses.replace(boxes, valid=torch.zeros_like(boxes.valid))
    nothing, none = nearest_velocities(unmoved, 2, moving_mps=0.5)
    assert not none.any()
    assert nothing.isfinite().all()


def test_pretraining_reaches_all_but_the_planner_and_finetuning_that_too(example: Example) -> None:
    before = gradients(DriveWorldObjective(agent(), PRETRAINING, steps=STEPS), example)
    assert not any(reached for name, reached in before.items() if name.startswith("planner."))
    # Lift, splat looks at the finest level alone.
    left_out = {name for name, reached in before.items() if not reached and name.startswith("world_model.")}
    assert left_out == {f"world_model.backbone.smooth.1.{kind}" for kind in ("weight", "bias")}
    joint = gradients(DriveWorldObjective(agent(), PLANNING, steps=STEPS), example)
    weights = dataclasses.replace(PLANNING.weights, kl=0.0, occ=0.0, action=0.0, flow=0.0, velocity=0.0)
    alone = dataclasses.replace(PLANNING, weights=weights)
    planning = gradients(DriveWorldObjective(agent(), alone, steps=STEPS), example)
    for reached in (joint, planning):
        assert reached["planner.plan"]
        assert reached["world_model.encoder.depth_and_context.weight"]
    assert joint["world_model.occupancy.weight"]
    assert not planning["world_model.occupancy.weight"]


def test_without_time_only_what_a_single_frame_shows_is_learned(example: Example) -> None:
    objective = DriveWorldObjective(agent(), dataclasses.replace(PRETRAINING, temporal=False), steps=STEPS)
    assert set(objective(example, torch.Generator())) == {"occ", "flow", "loss"}
    reached = gradients(objective, example)
    assert reached["world_model.backbone.lateral.0.weight"]
    assert reached["world_model.statics.net.0.weight"]
    assert not any(hit for name, hit in reached.items() if ".states." in name or ".to_vector." in name)


def test_a_seed_decides_what_is_drawn(example: Example) -> None:
    objective = DriveWorldObjective(agent(), PRETRAINING, steps=STEPS)
    first, again, other = (objective(example, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first["loss"], again["loss"])
    assert not torch.equal(first["occ"], other["occ"])


def test_the_terms_of_equation_3_are_sums_over_frames_if_the_weights_say_so(example: Example) -> None:
    """T observed and L imagined frames; the last action of a clip is unknown."""
    observed, every = PAST + 1, PAST + 1 + STEPS
    frames = {"kl": observed, "velocity": observed, "occ": every, "flow": every, "action": every - 1}
    found = {}
    for over_frames in ("mean", "sum"):
        weights = dataclasses.replace(PLANNING.weights, over_frames=over_frames)
        stage = dataclasses.replace(PLANNING, weights=weights)
        objective = DriveWorldObjective(agent(), stage, steps=STEPS).eval()
        found[over_frames] = objective(example, torch.Generator().manual_seed(0))
    mean, total = found["mean"], found["sum"]
    for name, count in frames.items():
        torch.testing.assert_close(total[name], count * mean[name], msg=name)
    torch.testing.assert_close(total["wpts"], mean["wpts"])
    weighted = sum(getattr(PLANNING.weights, name) * total[name] for name in (*frames, "wpts"))
    torch.testing.assert_close(total["loss"], weighted)


def test_base_learns_occupancy_by_cross_entropy_alone() -> None:
    """Eq. 3 has no affinity loss and no weight of occupied voxels."""
    recipe = find_recipe("driveworld_base")
    for stage in (recipe.pretrain, recipe.finetune):
        assert (stage.weights.scal, stage.weights.bce, stage.weights.occupied) == (0.0, 1.0, 1.0)
