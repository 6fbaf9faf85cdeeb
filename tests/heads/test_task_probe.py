"""Targets of the task heads by hand and under mirroring, and heads that learn one scene."""

import dataclasses
import math
from collections.abc import Iterator

import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.data.truth.mirrored import mirrored_truth
from foredrive.engine.parameter_groups import parameter_groups
from foredrive.geometry.se3 import matrix_from_yaw, transform_points
from foredrive.heads.agents_head import AGENT_CLASSES, AgentHeadConfig
from foredrive.heads.decoder import DecoderConfig
from foredrive.heads.heads import TaskHeads, TaskHeadsConfig, VoxelHeadConfig
from foredrive.heads.losses import TaskWeights, task_losses
from foredrive.heads.map_head import MapHeadConfig, RasterHeadConfig
from foredrive.heads.motion_head import MotionConfig
from foredrive.heads.probe import ProbeObjective, TaskExample, TaskVolumes, mirrored_item
from foredrive.heads.targets import agent_targets, map_targets
from foredrive.scene import Boxes, Category, VoxelSpec
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import ElementKind, MapElements, MapRaster, PlaneSpec, RasterLayer
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth

SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(2, 16, 16))
RASTER = PlaneSpec((-8.0, -8.0), 1.0, (16, 16))
STEPS = 4
TASKS = ("detection", "motion", "map", "occupancy")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Threads would wait for each other longer than they work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def boxes(rows: list[tuple[Category, float, float]], points: list[int]) -> Boxes:
    """Boxes that head along x, of 4 x 2 x 1.5 m, at 2 m/s, at given places."""
    n = len(rows)
    return Boxes(
        centre=torch.tensor([[x, y, 0.5] for _, x, y in rows]),
        size_lwh=torch.tensor([4.0, 2.0, 1.5]).expand(n, 3),
        yaw=torch.zeros(n),
        velocity=torch.tensor([2.0, 0.0]).expand(n, 2),
        track_id=torch.arange(n),
        category=torch.tensor([int(kind) for kind, *_ in rows]),
        valid=torch.ones(n, dtype=torch.bool),
        num_points=torch.tensor(points),
        attribute=torch.zeros(n, dtype=torch.long),
        visibility=torch.full((n,), -1),
    )


def futures(of: Boxes) -> AgentFutures:
    """They go on along x, at 2 m/s."""
    t_s = 0.5 * torch.arange(1, STEPS + 1)
    xy = of.centre[:, None, :2] + of.velocity[:, None] * t_s[:, None]
    return AgentFutures(xy, torch.zeros(xy.shape[:2]), torch.ones(xy.shape[:2], dtype=torch.bool), 0.5)


def scene() -> TaskExample:
    """Two vehicles, a divider and a crossing, each with a mark in the volume."""
    found = boxes([(Category.CAR, 3.0, 2.0), (Category.TRUCK, -4.0, -3.0)], [5, 5])
    divider = torch.tensor([[-6.0, 1.0], [6.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    crossing = torch.tensor([[2.0, -6.0], [4.0, -6.0], [4.0, -2.0], [2.0, -2.0], [2.0, -6.0]])
    elements = MapElements(
        vertices=torch.stack([divider, crossing]),
        valid=torch.tensor([[True, True, False, False, False], [True] * 5]),
        kind=torch.tensor([int(ElementKind.DIVIDER), int(ElementKind.CROSSING)]),
        known=torch.tensor(True),
    )
    layers = torch.zeros(len(RasterLayer), 16, 16, dtype=torch.bool)
    layers[RasterLayer.DIVIDER, 9, 2:14] = True
    layers[RasterLayer.DRIVABLE, 4:12] = True
    index = torch.full(SPEC.shape_zyx, 17, dtype=torch.uint8)
    index[0] = 11
    index[1, 9:11, 9:13] = 4
    everywhere = torch.ones(SPEC.shape_zyx, dtype=torch.bool)
    volume = torch.zeros(4, *SPEC.shape_zyx)
    volume[0, 1, 9:11, 9:13] = volume[1, 1, 4:6, 2:6] = volume[2, 0, 9, 2:14] = volume[3, 0] = 1.0
    volume += 0.05 * torch.randn(volume.shape, generator=torch.Generator().manual_seed(0))
    return TaskExample(
        volumes=TaskVolumes(volume[None], TASKS, (0, 0, 0, 0)),
        boxes=found,
        boxes_valid=torch.tensor(True),
        truth=TaskTruth(
            futures=futures(found),
            elements=elements,
            raster=MapRaster(RASTER, layers, torch.tensor(True)),
            semantics=SemanticVoxels(SPEC, "occ3d", index, everywhere, everywhere, everywhere),
        ),
        T_world_ego=torch.eye(4, dtype=torch.float64),
        key=(),
    )


def small_heads() -> TaskHeads:
    decoder = DecoderConfig(layers=1, heads=2)
    config = TaskHeadsConfig(
        width=32,
        max_cells=8,
        agents=AgentHeadConfig(queries=9, decoder=decoder, motion=MotionConfig(3, STEPS, 0.5, decoder)),
        elements=MapHeadConfig(elements=4, points=5, decoder=decoder),
        raster=RasterHeadConfig(),
        voxels=VoxelHeadConfig(),
    )
    torch.manual_seed(0)
    return TaskHeads(config, SPEC, channels=4, raster=RASTER)


def test_targets_are_the_boxes_that_nuscenes_counts() -> None:
    """An animal has no class, a box without points is not counted, one beyond the grid cannot be found."""
    kinds = [Category.ANIMAL, Category.CAR, Category.BUS, Category.PEDESTRIAN, Category.BARRIER]
    places = [(0.0, 0.0), (1.0, 0.0), (20.0, 0.0), (2.0, 1.0), (-3.0, -7.9)]
    given = boxes([(kind, *place) for kind, place in zip(kinds, places, strict=True)], [5, 0, 5, -1, 5])
    targets = agent_targets(given, futures(given), SPEC, STEPS)
    assert [AGENT_CLASSES[n] for n in targets.boxes.label] == [Category.PEDESTRIAN, Category.BARRIER]
    assert targets.boxes.state[0].tolist() == pytest.approx(
        [2, 1, 0.5, math.log(4), math.log(2), math.log(1.5)]
    )
    assert targets.future_xy[0].tolist() == [[3, 1], [4, 1], [5, 1], [6, 1]]
    assert not agent_targets(given, None, SPEC, STEPS).future_valid.any()
    assert agent_targets(given, futures(given), SPEC, 0).future_xy.shape == (2, 0, 2)  # detection alone


def test_map_targets_have_points_at_equal_distances() -> None:
    elements = scene().truth.elements
    assert elements is not None
    targets = map_targets(elements, 3, 5)
    assert targets.kind.tolist() == [ElementKind.DIVIDER, ElementKind.CROSSING]
    assert targets.orders[0, 0].tolist() == [[-6, 1], [-3, 1], [0, 1], [3, 1], [6, 1]]
    assert targets.orders[1, 0].tolist() == [[2, -6], [4, -5], [4, -2], [2, -3], [2, -6]]
    assert len(map_targets(elements, 1, 5).kind) == 1


def test_targets_of_a_mirrored_scene_are_the_mirrored_targets() -> None:
    item = scene()
    mirrored = mirrored_truth(stack_records([item.truth]), torch.tensor([True]))[0]
    flip = torch.tensor([1.0, -1.0])
    before, after = map_targets(item.truth.elements, 3, 5), map_targets(mirrored.elements, 3, 5)
    torch.testing.assert_close(after.orders, before.orders * flip)
    other = dataclasses.replace(item.boxes, centre=item.boxes.centre * torch.tensor([1.0, -1.0, 1.0]))
    old = agent_targets(item.boxes, item.truth.futures, SPEC, STEPS)
    new = agent_targets(other, mirrored.futures, SPEC, STEPS)
    torch.testing.assert_close(new.future_xy, old.future_xy * flip)
    torch.testing.assert_close(new.boxes.state[:, :2], old.boxes.state[:, :2] * flip)


def test_order_and_padding_of_the_truth_change_nothing() -> None:
    item, heads = scene(), small_heads()
    turned = dataclasses.replace(
        item,
        boxes=item.boxes.map_tensors(lambda tensor: tensor.flip(0)),
        truth=dataclasses.replace(
            item.truth,
            futures=item.truth.futures.map_tensors(lambda tensor: tensor.flip(0)),
            elements=_turned(item.truth.elements),
        ),
    )
    many = boxes([(Category.CAR, float(x), 0.0) for x in range(-4, 4)], [5] * 8)
    crowd = dataclasses.replace(
        item, boxes=many, truth=dataclasses.replace(item.truth, futures=futures(many))
    )
    objective = ProbeObjective(heads, SPEC, TaskWeights())
    generator = torch.Generator()
    alone = objective(stack_records([item]), generator)
    flipped = objective(stack_records([turned]), generator)
    for name, value in alone.items():
        assert flipped[name].item() == pytest.approx(value.item(), rel=1e-4), name
    batch = stack_records([item, crowd])  # pads the boxes of the first to 8
    padded = dataclasses.replace(batch[:1], volumes=stack_records([item]).volumes)
    for name, value in objective(padded, generator).items():
        assert value.item() == pytest.approx(alone[name].item(), rel=1e-4), name


def _turned(elements: MapElements) -> MapElements:
    return dataclasses.replace(
        elements,
        vertices=elements.vertices.flip(0),
        valid=elements.valid.flip(0),
        kind=elements.kind.flip(0),
    )


def test_what_a_log_lacks_trains_nothing() -> None:
    item, heads = stack_records([scene()]), small_heads()
    truth = dataclasses.replace(
        item.truth,
        elements=dataclasses.replace(item.truth.elements, known=torch.tensor([False])),
        raster=dataclasses.replace(item.truth.raster, known=torch.tensor([False])),
        semantics=None,
    )
    output = heads(item.volumes.by_task())
    losses = task_losses(output, item.boxes, torch.tensor([False]), truth, SPEC, None, TaskWeights())
    assert set(losses) == {
        "centres", "cells", "queries", "velocity", "attribute", "motion", "elements", "raster", "loss"
    }  # fmt: skip
    assert all(value.item() == 0 for value in losses.values())
    losses["loss"].backward()  # a step with such a batch is possible


@pytest.mark.slow
def test_heads_learn_one_scene() -> None:
    """Boxes, futures, lines, raster and voxels of one frame, after 120 steps."""
    batch, heads = stack_records([scene()]), small_heads()
    objective = ProbeObjective(heads, SPEC, TaskWeights())
    optimizer = torch.optim.AdamW(parameter_groups(objective, 1e-2), 5e-3)
    generator = torch.Generator()
    for _ in range(120):
        optimizer.zero_grad()
        objective(batch, generator)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(objective.parameters(), 10.0)
        optimizer.step()
    with torch.no_grad():
        found = heads(batch.volumes.by_task())
    agents = found.agents[-1][0]
    detections = agents.boxes.detections()
    first = detections.existence.argsort(descending=True)[:2]
    assert (detections.existence[first] > 0.5).all()
    at = agents.boxes.mean[first]
    car = int(at[:, 0].argmax())
    assert at[car, :2].tolist() == pytest.approx([3, 2], abs=0.7)
    assert at[1 - car, :2].tolist() == pytest.approx([-4, -3], abs=0.7)
    assert [AGENT_CLASSES[int(n)] for n in detections.log_class[first].argmax(-1)][car] == Category.CAR
    true_end = torch.tensor([7.0, 2.0])
    assert (agents.future_xy[first[car], :, -1] - true_end).norm(dim=-1).min() < 1.0
    raster = found.raster[0] > 0
    truth = batch.truth.raster.layers[0]
    assert (raster & truth).sum() / (raster | truth).sum() > 0.8
    assert (found.voxels[0].argmax(0) == batch.truth.semantics.index[0]).float().mean() > 0.9
    lines = found.elements[-1][0]
    divider = lines.points[lines.logits[:, ElementKind.DIVIDER].argmax()]
    assert divider[:, 1].tolist() == pytest.approx([1] * 5, abs=1.0)


def test_a_mirrored_item_has_mirrored_volumes_boxes_and_truth() -> None:
    """A mark at a vehicle stays at the vehicle, also in the volume of the past; twice is as before."""
    item = scene()
    pose = matrix_from_yaw(torch.tensor(0.3), torch.tensor([2.0, 1.0, 0.0]))
    volumes = dataclasses.replace(item.volumes, past=item.volumes.volume[0], T_past_now=pose)
    batch = stack_records([dataclasses.replace(item, volumes=volumes)] * 2)
    once = mirrored_item(batch, torch.tensor([True, False]))
    assert once.boxes.centre[0, 0].tolist() == [3, -2, 0.5]
    assert once.volumes.volume[0, 0, 0, 1, 5:7, 9:13].min() > 0.8
    assert torch.equal(once.volumes.past, once.volumes.volume[:, 0])
    ahead = torch.tensor([[[5.0, 2.0, 0.0]], [[5.0, -2.0, 0.0]]])
    seen = transform_points(once.volumes.T_past_now, ahead)
    other = transform_points(batch.volumes.T_past_now, ahead * torch.tensor([1.0, -1.0, 1.0]))
    torch.testing.assert_close(seen[0], other[0] * torch.tensor([1.0, -1.0, 1.0]))
    assert once.truth.elements.vertices[0, 0, 0].tolist() == [-6, -1]
    assert torch.equal(once.volumes.volume[1], batch.volumes.volume[1])
    twice = mirrored_item(once, torch.tensor([True, False]))
    torch.testing.assert_close(twice.volumes.volume, batch.volumes.volume)
    torch.testing.assert_close(twice.volumes.T_past_now, batch.volumes.T_past_now)
