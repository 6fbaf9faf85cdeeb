"""Metrics of the task heads: the truth as a prediction is perfect, and each baseline is what it says."""

import dataclasses
import itertools
from collections.abc import Callable

import pytest
import torch

from foredrive.scene import Attribute, Boxes, Category, Example, VoxelSpec
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.map_elements import ElementKind, MapElements, MapRaster, PlaneSpec
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth
from foredrive.tasks.detection.detection_metric import DetectionMetric
from foredrive.tasks.maps.map_lines_metric import MapLinesMetric, _part_above
from foredrive.tasks.maps.map_raster_metric import MapRasterMetric
from foredrive.tasks.metric import EvaluationContext
from foredrive.tasks.motion.motion_metric import MotionMetric
from foredrive.tasks.occupancy.semantics_metric import SemanticVoxelMetric
from foredrive.tasks.predictor import Prediction
from foredrive.tasks.task_priors import TaskPriors, best_mask, fit_task_priors

SPEC = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=1.0, shape_zyx=(2, 8, 8))
RASTER = PlaneSpec((-4.0, -4.0), 1.0, (8, 8))
STEPS = 12
CAR, WALKER = int(Category.CAR), int(Category.PEDESTRIAN)
MakeExample = Callable[..., Example]


@pytest.fixture
def example(make_example: MakeExample) -> Example:
    """Two items; in each a car at 4 m/s, one at rest, and a pedestrian that turns; and a small map."""
    made = make_example(0, 1)
    frames = made.clip.t_s.shape[1]
    attribute = [Attribute.VEHICLE_MOVING, Attribute.VEHICLE_PARKED, Attribute.PEDESTRIAN_MOVING]
    boxes = Boxes(
        centre=torch.tensor([[10.0, 0.0, 1.0], [20.0, 5.0, 1.0], [5.0, -6.0, 1.0]]),
        size_lwh=torch.tensor([4.0, 2.0, 1.5]).expand(3, 3),
        yaw=torch.zeros(3),
        velocity=torch.tensor([[4.0, 0.0], [0.0, 0.0], [1.0, 0.0]]),
        track_id=torch.arange(3),
        category=torch.tensor([CAR, CAR, WALKER]),
        valid=torch.ones(3, dtype=torch.bool),
        num_points=torch.full((3,), 9),
        attribute=torch.tensor(attribute),
        visibility=torch.full((3,), -1),
    ).map_tensors(lambda tensor: tensor.expand(2, frames, *tensor.shape))
    xy = _steady(boxes[:, 0]).clone()
    xy[:, 2, :, 1] += 0.25 * torch.arange(1, STEPS + 1)  # the pedestrian drifts to the left
    futures = AgentFutures(xy, torch.zeros(2, 3, STEPS), torch.ones(2, 3, STEPS, dtype=torch.bool), 0.5)
    lines = torch.tensor(
        [[[-20.0, 3.0], [20.0, 3.0]], [[5.0, -9.0], [5.0, 9.0]], [[-20.0, -9.0], [20.0, -9.0]]]
    )
    elements = MapElements(
        vertices=lines.expand(2, -1, -1, -1),
        valid=torch.ones(2, 3, 2, dtype=torch.bool),
        kind=torch.tensor([ElementKind.DIVIDER, ElementKind.CROSSING, ElementKind.BOUNDARY]).expand(2, 3),
        known=torch.tensor([True, False]),
    )
    layers = torch.zeros(2, 4, 8, 8, dtype=torch.bool)
    layers[:, 0, 3], layers[:, 1, :, 6], layers[:, 2, 0], layers[:, 3, 1:6] = True, True, True, True
    index = torch.full((2, *SPEC.shape_zyx), 17, dtype=torch.uint8)
    index[:, 0], index[:, 1, 3:5] = 11, 4
    some = torch.ones(2, *SPEC.shape_zyx, dtype=torch.bool)
    truth = TaskTruth(
        futures=futures,
        elements=elements,
        raster=MapRaster(RASTER, layers, torch.tensor([True, False])),
        semantics=SemanticVoxels(SPEC, "occ3d", index, some, some, some),
    )
    return dataclasses.replace(made, clip=dataclasses.replace(made.clip, boxes=boxes), truth=truth)


def _steady(boxes: Boxes) -> torch.Tensor:
    t_s = 0.5 * torch.arange(1, STEPS + 1)
    return boxes.centre[..., None, :2] + boxes.velocity[..., None, :] * t_s[:, None]


def perfect_agents(example: Example, score: float = 0.9) -> Agents:
    boxes = example.clip.boxes[:, 0]
    assert example.truth is not None
    assert example.truth.futures is not None
    return Agents(
        centre=boxes.centre,
        size_lwh=boxes.size_lwh,
        yaw=boxes.yaw,
        velocity=boxes.velocity,
        category=boxes.category,
        score=torch.full_like(boxes.yaw, score),
        attribute=boxes.attribute,
        track_id=torch.full_like(boxes.category, -1),
        future_xy=example.truth.futures.xy[:, :, None],
        log_prob=torch.zeros(2, 3, 1),
    )


def figures(metric: object, prediction: Prediction, truth: Example, priors: TaskPriors | None = None) -> dict:
    started = metric(EvaluationContext(0.5, task_priors=priors))  # type: ignore[operator]
    started.update(prediction, truth)
    return started.result()


def test_the_truth_as_detections(example: Example) -> None:
    """Two of ten classes are there and found; the errors of the other eight are 1 by definition."""
    found = figures(DetectionMetric, Prediction(agents=perfect_agents(example)), example)
    assert found["nuscenes.map"] == pytest.approx(0.2)
    assert found["car_ap_2m_30m"] == pytest.approx(1)
    assert found["nuscenes.ate_m"] == pytest.approx(0.8)
    assert found["nuscenes.map.nothing_detected"] == found["nuscenes.nds.nothing_detected"] == 0
    assert found["frames_counted"] == 2
    assert found["car_ap_2m_30m.true"] == 4


def above(example: Example, lower_m: tuple[float, float], shape_yx: tuple[int, int]) -> Example:
    """The example on another grid of 1 m."""
    spec = VoxelSpec((*lower_m, -1.0), 1.0, (2, *shape_yx))
    return dataclasses.replace(example, occupancy=dataclasses.replace(example.occupancy, spec=spec))


def test_no_more_than_what_the_grid_holds_can_be_detected(example: Example) -> None:
    """The car at x = 10 m is above the grid, that at 20 m is not: precision is 1 up to a recall of 0.5."""
    small = above(example, (-4.0, -8.0), (16, 16))
    found = figures(DetectionMetric, Prediction(agents=perfect_agents(small)), small)
    car = pytest.approx(0.4 / 0.9, abs=0.01)
    assert found["car_ap_2m_30m.ceiling"] == car
    assert 10 * found["nuscenes.map.ceiling"] - 1 == car
    assert found["car_ap_2m_30m"] == pytest.approx(1)


def test_no_more_than_what_the_grid_holds_can_be_mapped(example: Example) -> None:
    """All of the crossing is above the grid, a half of the divider, and nothing of the boundary."""
    assert example.truth is not None
    assert example.truth.elements is not None
    lines = MapLines(example.truth.elements.vertices, example.truth.elements.kind, torch.full((2, 3), 0.9))
    for lower_m, shape_yx, ceiling in (((-30.0, -10.0), (20, 60), 1.0), ((0.0, -9.0), (18, 20), 1 / 3)):
        grid = above(example, lower_m, shape_yx)
        found = figures(MapLinesMetric, Prediction(map_lines=lines), grid)
        assert found["maptr.map.ceiling"] == pytest.approx(ceiling)
        assert found["maptr.map"] == pytest.approx(1)


@pytest.mark.parametrize("first", range(5))
def test_a_crossing_may_begin_anywhere(first: int) -> None:
    """Shapely 2.2 cuts a closed line at its first vertex too: 3.8 m twice in place of 7.6 m."""
    ring = torch.tensor([[4.0, 11.0], [6.0, 11.0], [6.0, 15.0], [2.0, 15.0], [2.0, 11.0]]).roll(first, 0)
    closed = torch.cat([ring, ring[:1]]).double().numpy()
    part, share = _part_above(closed, VoxelSpec((0.0, 0.0, -1.0), 0.8, (2, 16, 16)))
    assert len(part) == 5
    assert share == pytest.approx(7.6 / 16)


def test_detections_three_metres_off_are_none_within_two(example: Example) -> None:
    agents = perfect_agents(example)
    off = dataclasses.replace(agents, centre=agents.centre + torch.tensor([3.0, 0.0, 0.0]))
    found = figures(DetectionMetric, Prediction(agents=off), example)
    assert found["car_ap_2m_30m"] == 0
    assert found["nuscenes.map"] == pytest.approx(0.2 / 4)  # at 4 m alone


def test_frames_without_annotation_do_not_count(example: Example) -> None:
    some = dataclasses.replace(
        example.clip, boxes_valid=torch.tensor([[True], [False]]).expand_as(example.clip.boxes_valid)
    )
    truth = dataclasses.replace(example, clip=some)
    for metric in (DetectionMetric, MotionMetric):
        found = figures(metric, Prediction(agents=perfect_agents(example)), truth)
        assert found["frames_counted"] == 1


def test_forecasts_stand_beside_constant_velocity(example: Example) -> None:
    """The pedestrian drifts by 0.25 m a step: 0.25 · 6.5 m on average, and 3 m at the end."""
    found = figures(MotionMetric, Prediction(agents=perfect_agents(example)), example)
    for protocol in ("uniad", "sparsedrive", "vad"):
        assert found[f"{protocol}.car.min_ade_m"] == pytest.approx(0, abs=1e-5)
        assert found[f"{protocol}.pedestrian.min_ade_m"] == pytest.approx(0, abs=1e-5)
        assert found[f"{protocol}.car.min_ade_m.constant_velocity"] == pytest.approx(0, abs=1e-5)
    assert found["uniad.pedestrian.min_ade_m.constant_velocity"] == pytest.approx(0.25 * 6.5)
    assert found["uniad.pedestrian.min_fde_m.constant_velocity"] == pytest.approx(3)
    assert found["vad.pedestrian.min_fde_m.constant_velocity"] == pytest.approx(1.5)
    assert found["uniad.car.matched"] == 4


def test_agents_without_forecasts_have_no_motion(example: Example) -> None:
    agents = dataclasses.replace(perfect_agents(example), future_xy=None, log_prob=None)
    assert figures(MotionMetric, Prediction(agents=agents), example) == {}


def test_maps_count_where_a_log_has_one(example: Example) -> None:
    assert example.truth is not None
    assert example.truth.elements is not None
    assert example.truth.raster is not None
    lines = MapLines(example.truth.elements.vertices, example.truth.elements.kind, torch.full((2, 3), 0.9))
    found = figures(MapLinesMetric, Prediction(map_lines=lines), example)
    assert found["maptr.map"] == found["streammapnet.ap_boundary"] == pytest.approx(1)
    assert found["lines.frames_counted"] == 1
    half = TaskPriors(layers=example.truth.raster.layers[0] & (torch.arange(8) < 4))
    shown = example.truth.raster.layers.float()
    masks = figures(MapRasterMetric, Prediction(map_layers=shown), example, half)
    assert masks["uniad.iou_lanes"] == masks["uniad.iou_drivable"] == 1
    assert masks["uniad.iou_drivable.best_constant"] == pytest.approx(0.5)
    assert masks["raster.frames_counted"] == 1


def test_maps_above_the_voxels_are_counted_alone_too(example: Example) -> None:
    """Voxels lie above the columns 2 to 4: what is wrong elsewhere does not count there."""
    assert example.truth is not None
    assert example.truth.raster is not None
    small = above(example, (-2.0, -4.0), (8, 3))
    shown = example.truth.raster.layers.float()
    shown[:, 3, :, 5:] = 0
    masks = figures(MapRasterMetric, Prediction(map_layers=shown), small)
    assert masks["uniad.iou_drivable"] == pytest.approx(5 / 8)
    assert masks["uniad_covered.iou_drivable"] == 1
    shown[:, 3, :, 4] = 0
    masks = figures(MapRasterMetric, Prediction(map_layers=shown), small)
    assert masks["uniad_covered.iou_drivable"] == pytest.approx(2 / 3)


def test_semantic_voxels_beside_the_commonest_class(example: Example) -> None:
    """The prior knows the road but not the vehicles: IoU 1 and 0."""
    assert example.truth is not None
    semantics = example.truth.semantics
    assert semantics is not None
    prior = semantics.index[0].clone()
    prior[1] = 17
    found = figures(
        SemanticVoxelMetric, Prediction(semantics=semantics.index), example, TaskPriors(semantics=prior)
    )
    assert found["occ3d.miou_pct"] == found["occ3d_unmasked.miou_pct"] == 100
    assert found["occ3d.miou_pct.best_constant"] == 50
    assert found["occ3d.frames_counted"] == 2
    assert found["openocc.miou_pct"] == 100
    assert found["openocc.iou_pct.car"] == found["occ3d.iou_pct.car"] == 100
    assert not any(key.startswith("occ3d_unmasked.iou_pct.") for key in found)
    assert not any("rayiou" in key or "occ_score" in key for key in found)  # no places of the lidar


def test_the_best_constant_mask_is_the_best_of_all() -> None:
    """All masks of 2 x 3 cells, against drawings whose frequencies are given."""
    drawn = torch.rand(7, 2, 3, generator=torch.Generator().manual_seed(0)) < torch.tensor(
        [[0.9, 0.5, 0.1], [0.3, 0.6, 0.0]]
    )

    def iou(mask: torch.Tensor) -> float:
        return float((drawn & mask).sum() / (drawn | mask).sum())

    best = best_mask(drawn.double().mean(0))
    masks = itertools.product([False, True], repeat=6)
    assert iou(best) == max(iou(torch.tensor(mask).view(2, 3)) for mask in masks)
    assert not best_mask(torch.zeros(2, 3)).any()


def test_priors_read_the_truth_that_is_known(example: Example) -> None:
    truth = example.truth
    assert truth is not None
    assert truth.raster is not None
    assert truth.semantics is not None
    items = [truth[0], truth[1]]
    priors = fit_task_priors(items)
    assert priors.layers is not None
    assert torch.equal(priors.layers, truth.raster.layers[0])
    assert priors.semantics is not None
    assert torch.equal(priors.semantics, truth.semantics.index[0])
    assert fit_task_priors([TaskTruth()]) == TaskPriors()
