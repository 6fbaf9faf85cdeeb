"""Instance occupancy: boxes that drive on, pixels of imagined beliefs in the frame of now, masks, losses."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
from torch import nn

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.heads.agents_head import AGENT_CLASSES, AgentHeadConfig, AgentSet, CarriedConfig
from foredrive.heads.detection_losses import MatchingLossConfig
from foredrive.heads.detection_network import BoxSet
from foredrive.heads.heads import TaskHeads, TaskHeadsConfig, TaskVolume
from foredrive.heads.instances_head import (
    MARGIN_M,
    InstanceHead,
    InstanceHeadConfig,
    InstanceSet,
    instance_logits,
    instance_raster,
)
from foredrive.heads.losses import TaskWeights, instance_loss, task_losses
from foredrive.heads.plane import Plane, PlanePyramid, cell_middles
from foredrive.scene import Boxes, Category, Example, VoxelSpec
from foredrive.scene.boxes import unlabelled
from foredrive.scene.map_elements import InstanceRaster, PlaneSpec
from foredrive.scene.task_truth import TaskTruth
from foredrive.tasks.metric import EvaluationContext
from foredrive.tasks.occupancy.instances_metric import InstanceMetric, drawn_boxes
from foredrive.tasks.predictor import Prediction

SPEC = VoxelSpec((-8.0, -12.0, -1.0), 1.0, (2, 24, 32))
GRID = PlaneSpec((-50.0, -50.0), 0.5, (200, 200))
STEPS = 4
CAR, WALKER = AGENT_CLASSES.index(Category.CAR), AGENT_CLASSES.index(Category.PEDESTRIAN)


def agents(rows: list[tuple[float, float, float, float]], label: int = CAR, score: float = 0.9) -> AgentSet:
    """A batch of one: x, y, yaw and speed along it of boxes of 4 x 2 x 1.5 m."""
    x, y, yaw, speed = torch.tensor(rows).T
    logits = torch.full((1, len(rows), len(AGENT_CLASSES) + 1), -20.0)
    logits[..., label], logits[..., -1] = math.log(score), math.log(1 - score)
    size = torch.tensor([4.0, 2.0, 1.5]).log().expand(len(rows), 3)
    mean = torch.cat([torch.stack([x, y, 0.7 * torch.ones_like(x)], dim=-1), size], dim=-1)
    heading = torch.stack([yaw.sin(), yaw.cos()], dim=-1)
    boxes = BoxSet(logits, mean[None], torch.zeros(1, len(rows), 6), heading[None], torch.zeros(1, len(rows)))
    velocity = speed[:, None] * heading.flip(-1)
    return AgentSet(boxes, velocity[None], torch.zeros(1, len(rows), 8))


def untrained(count: int, sharpness: float = 3.0) -> InstanceSet:
    return InstanceSet(
        embedding=torch.zeros(1, count, STEPS + 1, 4),
        sharpness=torch.full((1, count, STEPS + 1), sharpness),
        pixels=torch.randn(1, STEPS + 1, 4, *SPEC.shape_zyx[1:], generator=torch.Generator().manual_seed(0)),
        lower_m=SPEC.lower_m[:2],
        cell_m=SPEC.voxel_m,
        dt_s=0.5,
    )


def test_without_a_product_a_box_drives_on() -> None:
    """Along its heading of 30°, by 1.5 m a step; its edge has the logit 0."""
    yaw, found = math.pi / 6, agents([(2.0, 1.0, math.pi / 6, 3.0)])[0]
    ahead = torch.tensor([math.cos(yaw), math.sin(yaw)])
    start = torch.tensor([2.0, 1.0])
    points = torch.stack([start, start + 6.0 * ahead, start + (2.0 + MARGIN_M) * ahead, start + 99 * ahead])
    logits = instance_logits(untrained(1)[0], found, torch.tensor([0]), points)[0]
    torch.testing.assert_close(logits[0], torch.tensor([3.0, 3 * (1 - 6 / 2.25), 0.0, -9.0]))
    torch.testing.assert_close(logits[4, 1], torch.tensor(3.0))  # 6 m in four steps of 1.5 m
    left = start + (1.0 + MARGIN_M) * torch.tensor([-math.sin(yaw), math.cos(yaw)])
    assert float(instance_logits(untrained(1)[0], found, torch.tensor([0]), left[None])[0, 0, 0]) == (
        pytest.approx(0.0, abs=1e-5)
    )


def test_pixels_of_imagined_beliefs_are_read_where_the_ego_vehicle_will_be() -> None:
    """Each cell holds its own place; the ego vehicle drives 3 m and turns by 0.2 rad."""
    planes = PlanePyramid(SPEC, channels=2, width=16, max_cells=16, past=False)
    head = InstanceHead(planes, InstanceHeadConfig(width=2, steps=2))
    head.pixels = nn.Sequential(nn.Identity())
    place = cell_middles(SPEC.lower_m[:2], 1.0, SPEC.shape_zyx[1:]).T.unflatten(1, SPEC.shape_zyx[1:])[None]
    plane = Plane(place, SPEC.lower_m[:2], 1.0)
    T_now_later = matrix_from_yaw(torch.tensor([0.2]), torch.tensor([[3.0, 1.0, 0.0]]))[None]
    found = head(torch.zeros(1, 5, 16), plane, [plane], T_now_later)
    torch.testing.assert_close(found.pixels[0, 0], place[0])
    x, y = 10, 14  # of a cell well inside: its place at now, and as the later vehicle sees it
    at_now = place[0, :, y, x]
    later = torch.linalg.inv(T_now_later[0, 0]) @ torch.cat([at_now, torch.tensor([0.0, 1.0])])
    torch.testing.assert_close(found.pixels[0, 1, :, y, x], later[:2], atol=1e-4, rtol=0)
    assert not found.pixels[0, 2].any()  # the world model imagines one key frame alone
    assert (found.sharpness > 1).all()


def test_sequences_are_read_and_judged_at_their_last_frames() -> None:
    sizes = TaskHeadsConfig(
        16,
        agents=AgentHeadConfig(queries=8, motion=None, carried=CarriedConfig(agents=3, frames=2)),
        elements=None,
        raster=None,
        voxels=None,
        instances=InstanceHeadConfig(width=4),
    )
    torch.manual_seed(0)
    heads = TaskHeads(sizes, SPEC, channels=2, instance_grid=GRID)
    now, later = torch.randn(4, 2, *SPEC.shape_zyx), torch.randn(4, STEPS, 2, *SPEC.shape_zyx)
    eye = torch.eye(4).expand(4, 4, 4)
    volumes = {"tracking": TaskVolume(now, later=later, T_now_later=torch.eye(4).expand(4, STEPS, 4, 4))}
    sequences = heads(volumes, heads.config.steps(eye.double()))
    single = heads(volumes)
    torch.testing.assert_close(sequences.instances.pixels, single.instances.pixels[[1, 3]])

    x, y = sequences.agents[-1].boxes.mean[1, 0, :2].tolist()  # beside a query: far ones teach no mask
    found = agents([(x, y, 0.3, 4.0)])
    truth = TaskTruth(instances=truth_of(found)[[0] * 4])
    boxes = boxes_of(found)[[0] * 4]
    for annotated, trains in (([True, False, True, False], False), ([False, True, False, False], True)):
        loss = task_losses(
            sequences, boxes, torch.tensor(annotated), truth, SPEC, None, TaskWeights(), frames=2
        )
        assert bool(loss["instances"] > 0) is trains


def test_cells_belong_to_the_most_probable_vehicle() -> None:
    found = agents([(0.0, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0, 2.0), (-6.0, 5.0, 0.0, 0.0)])
    logits = found.boxes.logits.clone()
    logits[0, 2] = torch.tensor([*[-20.0] * len(AGENT_CLASSES), 0.0])  # nothing is there
    found = dataclasses.replace(found, boxes=dataclasses.replace(found.boxes, logits=logits))
    raster = instance_raster(untrained(3), found, GRID)[0]

    def at(step: int, x: float, y: float) -> int:
        return int(raster[step, round((y + 50) / 0.5), round((x + 50) / 0.5)])

    assert (at(0, 0.0, 0.0), at(0, 3.0, 0.0), at(0, -6.0, 5.0)) == (1, 2, 0)
    assert (at(0, 1.0, 0.0), at(0, 2.0, 0.0)) == (1, 2)  # where both boxes lie, the nearer middle
    assert (at(4, 7.0, 0.0), at(4, 3.5, 0.0)) == (2, 0)
    assert not instance_raster(untrained(3), agents([(0.0, 0.0, 0.0, 0.0)] * 3, WALKER), GRID).any()
    assert not instance_raster(untrained(3), agents([(0.0, 0.0, 0.0, 0.0)] * 3, score=0.2), GRID).any()


def test_two_queries_on_one_vehicle_do_not_share_its_cells() -> None:
    """The less certain one is 0.5 m ahead; all that is left to it are cells beyond the other's box."""
    found = agents([(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0)])
    logits = found.boxes.logits.clone()
    logits[0, 1, CAR], logits[0, 1, -1] = math.log(0.4), math.log(0.6)
    found = dataclasses.replace(found, boxes=dataclasses.replace(found.boxes, logits=logits))
    cells = instance_raster(untrained(2), found, GRID)[0, 0]
    alone = instance_raster(untrained(1), agents([(0.0, 0.0, 0.0, 0.0)]), GRID)[0, 0]
    assert int((cells == 1).sum()) >= 0.8 * int((alone == 1).sum())
    assert int((cells == 2).sum()) < 0.3 * int((cells == 1).sum())


def boxes_of(found: AgentSet) -> Boxes:
    mean, heading = found.boxes.mean, found.boxes.heading
    count = mean.shape[1]
    return Boxes(
        centre=mean[..., :3],
        size_lwh=mean[..., 3:].exp(),
        yaw=torch.atan2(heading[..., 0], heading[..., 1]),
        velocity=found.velocity,
        track_id=5 + torch.arange(count)[None],
        category=torch.full((1, count), int(Category.CAR)),
        valid=torch.ones(1, count, dtype=torch.bool),
        **unlabelled(1, count),
    )


def truth_of(found: AgentSet, moves: float = 1.0) -> InstanceRaster:
    empty = InstanceRaster(
        GRID, torch.zeros(STEPS + 1, 200, 200).long(), torch.ones(STEPS + 1, dtype=torch.bool), 0.5
    )
    drawn = torch.from_numpy(drawn_boxes(found.agents(0.5)[0], empty, moves)).long()
    ids = torch.where(drawn > 0, drawn + 5, 0)  # tracks 5, 6, … and one more
    return dataclasses.replace(empty, track_id=ids, valid=empty.valid)[None]


def test_the_loss_falls_as_features_learn_another_motion() -> None:
    """The true vehicles stand, the boxes drive on: the product has to correct them."""
    found = agents([(2.0, 2.0, 0.3, 4.0), (8.0, -5.0, -0.4, 4.0)])
    truth, driven = truth_of(found, moves=0.0), truth_of(found)
    features, valid = torch.nn.Parameter(torch.randn(1, STEPS + 1, 4, 24, 32)), torch.tensor([True])
    embedding = torch.nn.Parameter(torch.randn(1, 2, STEPS + 1, 4))
    optimizer = torch.optim.Adam([features, embedding], lr=0.1)
    mean = found.boxes.mean.requires_grad_()
    losses = []
    for _ in range(40):
        instances = dataclasses.replace(untrained(2), pixels=features, embedding=embedding)
        loss = instance_loss(instances, found, boxes_of(found), valid, truth, SPEC, MatchingLossConfig())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.4 * losses[0]
    assert mean.grad is None
    right = instance_loss(untrained(2), found, boxes_of(found), valid, driven, SPEC, MatchingLossConfig())
    assert float(right) < 0.5 * losses[0]  # boxes that drive as the truth does need no correction


@pytest.mark.parametrize(("row", "column"), [(100, 96), (101, 110), (92, 121), (83, 87)])
def test_every_cell_is_judged_by_one_of_four_items(row: int, column: int) -> None:
    found = agents([(2.0, 2.0, 0.3, 4.0)])
    truth = truth_of(found)
    changed = truth.track_id.clone()
    changed[:, 0, row, column] = torch.where(changed[:, 0, row, column] == 6, 0, 6)

    def losses(track_id: torch.Tensor) -> list[float]:
        batch = dataclasses.replace(truth, track_id=track_id)[[0] * 4]
        instances, four, boxes = (each[[0] * 4] for each in (untrained(1), found, boxes_of(found)))
        valid = torch.eye(4, dtype=torch.bool)
        return [
            float(instance_loss(instances, four, boxes, one, batch, SPEC, MatchingLossConfig()))
            for one in valid
        ]

    differs = [new != old for new, old in zip(losses(changed), losses(truth.track_id), strict=True)]
    assert sum(differs) == 1


@pytest.mark.parametrize(("off_m", "trains"), [(3.0, True), (5.0, False)])
def test_a_box_far_from_its_vehicle_learns_no_mask(off_m: float, trains: bool) -> None:
    found, true = agents([(2.0 + off_m, 2.0, 0.3, 4.0)]), agents([(2.0, 2.0, 0.3, 4.0)])
    valid, matching = torch.tensor([True]), MatchingLossConfig()
    loss = instance_loss(untrained(1), found, boxes_of(true), valid, truth_of(true), SPEC, matching)
    assert bool(loss > 0) is trains


def test_pedestrians_and_frames_without_annotation_train_nothing() -> None:
    found = agents([(2.0, 2.0, 0.3, 4.0)])
    walkers = dataclasses.replace(boxes_of(found), category=torch.full((1, 1), int(Category.PEDESTRIAN)))
    for boxes, valid in ((walkers, [True]), (boxes_of(found), [False])):
        loss = instance_loss(
            untrained(1), found, boxes, torch.tensor(valid), truth_of(found), SPEC, MatchingLossConfig()
        )
        assert float(loss) == 0.0


def test_figures_stand_beside_boxes_that_drive_on_or_stay(make_example: Callable[..., Example]) -> None:
    """The truth drives at constant velocity: the truth and that baseline are perfect, persistence is not."""
    found = agents([(2.0, 2.0, 0.3, 4.0), (8.0, -15.0, -0.4, 0.0)])
    truth = truth_of(found)
    metric = InstanceMetric(EvaluationContext(0.5))
    judged = dataclasses.replace(
        make_example(batch=1, spec=SPEC), truth=TaskTruth(instances=truth), key=("log@0",)
    )
    metric.update(Prediction(instances=truth.track_id, agents=found.agents(0.5)), judged)
    figures = metric.result()
    for name in ("iou_near", "iou_far", "vpq_near", "vpq_far"):
        assert figures[f"uniad.{name}_pct"] == figures[f"uniad.{name}_pct.constant_velocity"] == 100
        assert 0 < float(figures[f"uniad.{name}_pct.persistence"]) < 100
    # One of the two vehicles is above the voxels
    assert figures["uniad.vpq_far_pct.ceiling"] == pytest.approx(100 / 1.5)
    assert figures["uniad.frames_counted"] == 1
    half = dataclasses.replace(truth, valid=truth.valid.clone())
    half.valid[0, -1] = False
    metric.update(
        Prediction(instances=truth.track_id, agents=found.agents(0.5)),
        dataclasses.replace(judged, truth=TaskTruth(instances=half)),
    )
    assert metric.result()["uniad.frames_counted"] == 1
