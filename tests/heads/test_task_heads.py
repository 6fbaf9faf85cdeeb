"""Heads of the tasks: shapes, which parts exist, gradients, places, and that they can learn a scene."""

import dataclasses
import math

import pytest
import torch

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.heads.agents_head import AgentHeadConfig
from foredrive.heads.decoder import DecoderConfig
from foredrive.heads.heads import TaskHeads, TaskHeadsConfig, TaskVolume, VoxelHeadConfig
from foredrive.heads.map_head import MapHeadConfig, RasterHeadConfig, _on_canvas
from foredrive.heads.motion_head import MotionConfig, kinematic_motion
from foredrive.heads.plane import (
    Plane,
    PlaneFeatures,
    PlanePyramid,
    cell_middles,
    halvings,
    spread_points,
)
from foredrive.heads.proposals import CentreMap, best_proposals
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


def volumes(batch: int = 2) -> dict[Task, TaskVolume]:
    generator = torch.Generator().manual_seed(0)
    moved = matrix_from_yaw(torch.tensor([0.3, -0.2]), torch.tensor([[2.0, 0.5, 0.0], [1.0, 0.0, 0.0]]))[
        :batch
    ]

    def drawn() -> torch.Tensor:
        return torch.randn(batch, 3, *SPEC.shape_zyx, generator=generator)

    return {task: TaskVolume(drawn(), drawn(), moved) for task in TASKS}


def turned(volume: TaskVolume) -> TaskVolume:
    return dataclasses.replace(volume, now=volume.now.flip(-1))


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
    missing = ["agents", "centres"] if left_out == "agents" else [left_out]
    assert [name for name, value in vars(found).items() if value is None] == [
        *missing,
        "lineage",
        "instances",
    ]


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
        after = module({**given, task: turned(given[task])})
        old, new = getattr(before, same)[-1], getattr(after, same)[-1]
        assert all(torch.equal(a, b) for a, b in zip(_tensors(old), _tensors(new), strict=True))
    moved = module({**given, "motion": turned(given["motion"])}).agents[-1]
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
    records = [found.centres, *found.agents, *found.elements]
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
    assert module.agents.change[-1].weight.grad is None
    assert module.agents.centres.out.weight.grad is None
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


def test_a_pyramid_has_a_fine_and_a_coarse_plane() -> None:
    pyramid = PlanePyramid(SPEC, channels=1, width=16, max_cells=6, past=False)
    found = pyramid(torch.zeros(2, 1, *SPEC.shape_zyx))
    assert (found.fine.features.shape, found.fine.cell_m) == ((2, 8, 16, 24), 1.0)
    assert (found.coarse.features.shape, found.coarse.cell_m) == ((2, 16, 4, 6), 4.0)


def test_the_past_is_read_where_it_was_seen() -> None:
    """The vehicle drove 2 m and turned left by 90°: what was at (5, 3) is 1 m ahead and 3 m to the right."""
    pyramid = PlanePyramid(SPEC, channels=1, width=16, max_cells=12, past=True)
    past = torch.zeros(1, 1, 16, 24)
    past[0, 0, 8 + 3, 4 + 5] = 1.0
    T_past_now = matrix_from_yaw(torch.tensor([math.pi / 2]), torch.tensor([[2.0, 2.0, 0.0]]))
    # A point p of now lies at (2 - y, 2 + x) of the past, so (5.5, 3.5) is p = (1.5, -3.5).
    moved = pyramid._moved(past, T_past_now)[0, 0]
    assert moved.nonzero().tolist() == [[8 - 4, 4 + 1]]
    assert moved.max().item() == pytest.approx(1.0, abs=1e-5)


def test_a_vehicle_that_turned_keeps_what_stands() -> None:
    """Without a past volume, heads work too, and differ from heads that see one."""
    module, given = heads().eval(), volumes()
    alone = {task: TaskVolume(volume.now) for task, volume in given.items()}
    with torch.no_grad():
        assert not torch.allclose(module(alone).raster, module(given).raster)
        blind = heads(dataclasses.replace(CONFIG, past=False)).eval()
        torch.testing.assert_close(blind(alone).raster, blind(given).raster)


def test_points_are_spread_over_the_whole_plane() -> None:
    points = spread_points(SPEC.lower_m[:2], 2.0, (8, 12), 24)
    assert points.amin(0).tolist() == [-2, -6]  # 6 columns and 4 rows of 4 m
    assert points.amax(0).tolist() == [18, 6]


def centre_map(logits: torch.Tensor) -> CentreMap:
    """A map whose boxes tell their cell: x and y are its middle, z is its number."""
    b, _, rows, columns = logits.shape
    middle = cell_middles((0.0, 0.0), 1.0, (rows, columns)).view(1, rows, columns, 2).expand(b, -1, -1, -1)
    number = torch.arange(float(rows * columns)).view(1, rows, columns).expand(b, -1, -1)
    return CentreMap(logits, middle, number, middle.repeat(1, 1, 1, 2)[..., :3], middle, middle)


def test_proposals_are_the_highest_peaks_of_all_classes() -> None:
    logits = torch.full((2, 2, 4, 5), -5.0)
    logits[0, 0, 1, 1], logits[0, 0, 1, 2] = 3.0, 2.0  # the second is beside a higher one
    logits[0, 1, 3, 4] = 1.0
    logits[1, 1, 0, 0] = 4.0
    found = best_proposals(centre_map(logits), 2)
    assert found.cell[0].tolist() == [6, 19]
    assert found.label[0].tolist() == [0, 1]
    assert found.xy[0].tolist() == [[1.5, 1.5], [4.5, 3.5]]
    assert found.z[0].tolist() == [6, 19]
    assert found.logits[0].tolist() == [[3, -5], [-5, 1]]
    assert found.cell[1, 0].item() == 0


def test_kinematic_motion_by_hand() -> None:
    """At 4 m/s along y: steady, braking at 4 m/s² (2 m in the first second), turning; one stands."""
    velocity = torch.tensor([[0.0, 4.0], [0.0, 0.0]])
    heading = torch.tensor([[0.0, 1.0], [1.0, 0.0]])  # the first one's heading is not its direction
    modes = torch.tensor([0.0, -4.0, 0.0, 2.0]), torch.tensor([0.0, 0.0, 0.1, 0.0])
    found = kinematic_motion(velocity, heading, *modes, steps=4, dt_s=0.5)
    assert found[0, 0, :, 1].tolist() == [2, 4, 6, 8]
    assert found[0, 1, :, 1].tolist() == [1.5, 2, 2, 2]
    assert found[0, 2, -1].tolist() == pytest.approx([-0.7973, 7.9468], abs=2e-3)  # on a circle of 40 m
    assert found[1, 0].abs().max() == 0
    assert found[1, 3, -1].tolist() == pytest.approx([0, 4], abs=1e-5)  # ½ · 2 · 2² along its heading


def test_the_raster_of_a_larger_grid_lies_where_the_plane_is() -> None:
    """The gradient of a cell of the truth reaches the volume's columns around the same place."""
    config = dataclasses.replace(CONFIG, agents=None, elements=None, voxels=None)
    module = heads(config)
    canvas = module.raster
    marked = torch.zeros(1, 8, 16, 24)
    marked[0, 0, 3, 5] = 1.0  # middle at x 1.5, y -4.5
    shown = _on_canvas(Plane(marked, SPEC.lower_m[:2], 1.0), canvas.fine_m, canvas.fine_shape)
    row, column = shown[0, 0].nonzero()[0].tolist()
    assert canvas.fine_m.view(*canvas.fine_shape, 2)[row, column].tolist() == pytest.approx([1.5, -4.5])
    assert shown[0, -1].sum().item() == 14 * 16  # x from -4 to 10, y from -8 to 8 of the 20 m
