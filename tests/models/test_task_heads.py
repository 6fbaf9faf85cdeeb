"""Heads of the tasks: shapes, which parts exist, gradients, places, and that they can learn a scene."""

import dataclasses

import pytest
import torch

from foredrive.models.tasks.agents import AgentHeadConfig, MotionConfig, spread_points
from foredrive.models.tasks.decoder import DecoderConfig
from foredrive.models.tasks.heads import TaskHeads, TaskHeadsConfig
from foredrive.models.tasks.maps import MapHeadConfig, RasterHeadConfig
from foredrive.models.tasks.plane import Plane, PlaneFeatures, halvings
from foredrive.models.tasks.voxels import VoxelHeadConfig
from foredrive.scene import Task, VoxelSpec
from foredrive.scene.map_elements import PlaneSpec
from foredrive.scene.semantics import VOXEL_CLASSES

SPEC = VoxelSpec(lower_m=(-4.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(2, 16, 24))
RASTER = PlaneSpec((-10.0, -10.0), 1.0, (20, 20))
SMALL = DecoderConfig(layers=2, heads=2)
CONFIG = TaskHeadsConfig(
    width=16,
    max_cells=12,
    agents=AgentHeadConfig(queries=6, decoder=SMALL, motion=MotionConfig(modes=3, steps=4, decoder=SMALL)),
    elements=MapHeadConfig(elements=5, points=4, decoder=SMALL),
    raster=RasterHeadConfig(width=8),
    voxels=VoxelHeadConfig(hidden=8),
)
TASKS: tuple[Task, ...] = ("detection", "motion", "map", "occupancy")


def volumes(batch: int = 2) -> dict[Task, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {task: torch.randn(batch, 3, *SPEC.shape_zyx, generator=generator) for task in TASKS}


def heads(config: TaskHeadsConfig = CONFIG) -> TaskHeads:
    torch.manual_seed(0)
    return TaskHeads(config, SPEC, channels=3, raster=RASTER)


def test_all_heads_in_parallel() -> None:
    found = heads()(volumes())
    assert found.agents is not None
    assert found.elements is not None
    assert found.raster is not None
    assert found.voxels is not None
    assert len(found.agents) == len(found.elements) == 2  # one for each decoder layer
    agents = found.agents[-1]
    assert agents.future_xy is not None
    assert agents.log_prob is not None
    assert agents.boxes.mean.shape == (2, 6, 6)
    assert agents.future_xy.shape == (2, 6, 3, 4, 2)
    torch.testing.assert_close(agents.log_prob.exp().sum(-1), torch.ones(2, 6))
    assert found.agents[0].future_xy is None
    assert found.elements[-1].points.shape == (2, 5, 4, 2)
    assert found.raster.shape == (2, 4, 20, 20)
    assert found.voxels.shape == (2, len(VOXEL_CLASSES["occ3d"]), *SPEC.shape_zyx)


@pytest.mark.parametrize("left_out", ["agents", "elements", "raster", "voxels"])
def test_a_head_can_be_left_out(left_out: str) -> None:
    found = heads(dataclasses.replace(CONFIG, **{left_out: None}))(volumes())
    assert [name for name, value in vars(found).items() if value is None] == [left_out]


def test_only_the_volumes_of_the_tasks_are_needed() -> None:
    agents = dataclasses.replace(CONFIG.agents, motion=None)
    config = dataclasses.replace(CONFIG, agents=agents, elements=None, raster=None, voxels=None)
    assert config.tasks == ("detection",)
    found = heads(config)({"detection": volumes()["detection"]})
    assert found.agents is not None
    assert found.agents[-1].future_xy is None
    assert CONFIG.tasks == ("detection", "motion", "map", "occupancy")


def test_each_head_reads_the_volume_of_its_task() -> None:
    module, given = heads().eval(), volumes(1)
    before = module(given)
    for task, same in (("map", "agents"), ("detection", "elements"), ("occupancy", "agents")):
        after = module({**given, task: given[task] + 1})
        old, new = getattr(before, same)[-1], getattr(after, same)[-1]
        assert all(torch.equal(a, b) for a, b in zip(_tensors(old), _tensors(new), strict=True))
    moved = module({**given, "motion": given["motion"] + 1}).agents[-1]
    torch.testing.assert_close(moved.boxes.mean, before.agents[-1].boxes.mean)
    assert not torch.allclose(moved.future_xy, before.agents[-1].future_xy)


def _tensors(record: object) -> list[torch.Tensor]:
    found: list[torch.Tensor] = []
    for value in vars(record).values():
        if isinstance(value, torch.Tensor):
            found.append(value)
        elif dataclasses.is_dataclass(value):
            found += _tensors(value)
    return found


def test_gradients_reach_every_parameter() -> None:
    module = heads()
    found = module(volumes())
    records = [*found.agents, *found.elements]
    everything = [tensor for record in records for tensor in _tensors(record)] + [found.raster, found.voxels]
    torch.stack([tensor.square().sum() for tensor in everything]).sum().backward()
    untouched = [
        name for name, value in module.named_parameters() if value.grad is None or not value.grad.any()
    ]
    assert not untouched


def test_forecasts_pass_no_gradient_to_the_boxes() -> None:
    module, given = heads(), volumes()
    agents = module(given).agents[-1]
    agents.future_xy.sum().backward()
    assert module.agents.out[-1].weight.grad is None
    assert module.agents.motion.mode.grad.any()


def test_a_plane_is_read_where_its_cells_are() -> None:
    """Columns run along x: cell (y 1, x 2) of 2 m has its middle at x = -4 + 5, y = -8 + 3."""
    features = torch.zeros(1, 1, 8, 12)
    features[0, 0, 1, 2] = 1.0
    plane = Plane(features, SPEC.lower_m[:2], 2.0)
    assert plane.middle_m[12 + 2].tolist() == [1, -5]
    assert plane.cells[0, 12 + 2].item() == 1
    points = torch.tensor([[[1.0, -5.0], [2.0, -5.0], [1.0, -3.0], [99.0, -5.0]]])
    assert plane.at(points)[0, :, 0].tolist() == pytest.approx([1, 0.5, 0, 0])
    assert plane.share(torch.tensor([-4.0, 8.0])).tolist() == [0, 1]


def test_planes_are_halved_until_they_are_small_enough() -> None:
    assert [halvings(SPEC, cells) for cells in (24, 23, 12, 11, 32)] == [0, 1, 1, 2, 0]
    plane = PlaneFeatures(SPEC, channels=1, width=8, shrink=2)
    assert plane.shape_yx == (4, 6)
    assert plane(torch.zeros(1, 1, 2, 16, 24)).features.shape == (1, 8, 4, 6)


def test_points_are_spread_over_the_whole_plane() -> None:
    points = spread_points(PlaneFeatures(SPEC, channels=1, width=8, shrink=1), 24)
    assert points.amin(0).tolist() == [-2, -6]  # 6 columns and 4 rows of 4 m
    assert points.amax(0).tolist() == [18, 6]
