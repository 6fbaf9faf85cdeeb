"""DriveWorld's objective: what it looks at, and that descending it works."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.models.backbone import ImageBackbone
from foredrive.models.driveworld import DriveWorld, motion_of
from foredrive.models.driveworld.planes import PlanesToVolume, PlaneToVector, StaticScene, VectorToPlane
from foredrive.models.driveworld.state_space import StateSpace
from foredrive.models.lift_splat import LiftSplatEncoder
from foredrive.scene import Example, VoxelSpec
from foredrive.training.driveworld_objective import DriveWorldObjective, DriveWorldWeights, nearest_moving

SPEC = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=1.0, shape_zyx=(2, 8, 8))
PAST, STEPS = 1, 2


def world() -> DriveWorld:
    torch.manual_seed(0)
    return DriveWorld(
        backbone=ImageBackbone(
            embedding_size=8,
            hidden_sizes=(8,),
            depths=(1,),
            layer_type="basic",
            stages=("stage1",),
            channels=8,
        ),
        encoder=LiftSplatEncoder(SPEC, channels=8, width=8, near_m=1.0, far_m=5.0, step_m=1.0),
        states=StateSpace(observation=8, state=6, history=8, objects=4, heads=2, memory=4, hidden=16),
        to_vector=PlaneToVector(8, 4, 8),
        from_vector=VectorToPlane(14, (8, 8), (8, 8)),
        to_volume=PlanesToVolume(12, 4, 8, 2),
        statics=StaticScene(8, 4),
        prompt=None,
        past_frames=PAST,
        dt_s=0.5,
        channels=8,
    )


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
    objective = DriveWorldObjective(world(), DriveWorldWeights(), steps=STEPS)
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
    weights = DriveWorldWeights()
    assert first["loss"] == pytest.approx(
        sum(getattr(weights, name) * value for name, value in first.items() if name != "loss"), rel=1e-5
    )


def test_what_is_not_known_counts_for_nothing(example: Example) -> None:
    nothing = dataclasses.replace(
        example,
        occupancy=dataclasses.replace(example.occupancy, known=torch.zeros_like(example.occupancy.known)),
        clip=dataclasses.replace(example.clip, boxes_valid=torch.zeros_like(example.clip.boxes_valid)),
    )
    losses = DriveWorldObjective(world(), DriveWorldWeights(), steps=STEPS)(
        nothing, torch.Generator().manual_seed(0)
    )
    assert [losses[name].item() for name in ("occ", "velocity", "flow")] == [0.0, 0.0, 0.0]
    assert losses["loss"].isfinite()


def test_the_nearest_that_move_come_first(example: Example) -> None:
    boxes = example.clip.boxes
    centre = torch.tensor([[9.0, 0.0, 0.0], [5.0, 0.0, 0.0], [-2.0, 0.0, 0.0]]).expand_as(boxes.centre)
    velocity = torch.tensor([[1.0, 0.0], [2.0, 0.0], [0.1, 0.0]]).expand_as(boxes.velocity)
    found, there = nearest_moving(dataclasses.replace(boxes, centre=centre, velocity=velocity), 4)
    assert found[0, 0, :2, 0].tolist() == [2.0, 1.0]
    assert there[0, 0].tolist() == [True, True, False, False]
    nothing, none = nearest_moving(dataclasses.replace(boxes, valid=torch.zeros_like(boxes.valid)), 2)
    assert not none.any()
    assert nothing.isfinite().all()
