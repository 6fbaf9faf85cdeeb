"""Mirrored truth: left and right exchanged for the chosen items alone, and back again by a second time."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.data.augmentation import mirrored
from foredrive.errors import InputError
from foredrive.scene import Example, VoxelSpec
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.map_elements import InstanceRaster, MapElements, MapRaster, PlaneSpec
from foredrive.scene.semantics import SemanticVoxels
from foredrive.scene.task_truth import TaskTruth

PLANE = PlaneSpec((-2.0, -1.0), 0.5, (4, 8))
VOXELS = VoxelSpec((-2.0, -1.0, 0.0), 0.5, (2, 4, 8))


def truth(plane: PlaneSpec = PLANE) -> TaskTruth:
    """Two items; everything lies on the left, at y > 0."""
    layers = torch.zeros(2, 4, 4, 8, dtype=torch.bool)
    layers[:, 1, 3, 2] = True
    ids = torch.zeros(2, 5, 4, 8, dtype=torch.int64)
    ids[:, :, 2, 6] = 9
    index = torch.full((2, 2, 4, 8), 17, dtype=torch.uint8)
    index[:, 0, 3, 1] = 4
    yes = torch.ones(2, dtype=torch.bool)
    return TaskTruth(
        AgentFutures(
            torch.tensor([4.0, 1.0]).expand(2, 3, 12, 2),
            torch.full((2, 3, 12), 0.25),
            yes[:, None, None].expand(2, 3, 12),
            0.5,
        ),
        MapElements(
            torch.tensor([[0.0, 0.5], [2.0, 1.0]]).expand(2, 1, 2, 2),
            yes[:, None, None].expand(2, 1, 2),
            torch.zeros(2, 1).long(),
            yes,
        ),
        MapRaster(plane, layers, yes),
        SemanticVoxels(VOXELS, "occ3d", index, index < 17, index < 17, index < 17),
        InstanceRaster(plane, ids, yes[:, None].expand(2, 5), 0.5),
    )


@pytest.fixture
def example(make_example: Callable[..., Example]) -> Example:
    return dataclasses.replace(make_example(batch=2, spec=VOXELS), truth=truth())


def test_only_the_chosen_item_changes_sides(example: Example) -> None:
    found = mirrored(example, torch.tensor([True, False])).truth
    assert found is not None
    assert found.futures is not None
    assert found.elements is not None
    assert found.raster is not None
    assert found.semantics is not None
    assert found.instances is not None
    assert found.futures.xy[:, 0, 0].tolist() == [[4.0, -1.0], [4.0, 1.0]]
    assert found.futures.yaw[:, 0, 0].tolist() == [-0.25, 0.25]
    assert found.elements.vertices[:, 0, :, 1].tolist() == [[-0.5, -1.0], [0.5, 1.0]]
    assert found.raster.layers.nonzero().tolist() == [[0, 1, 0, 2], [1, 1, 3, 2]]
    assert found.semantics.known.nonzero().tolist() == [[0, 0, 0, 1], [1, 0, 3, 1]]
    assert (found.semantics.index == 4).nonzero().tolist() == [[0, 0, 0, 1], [1, 0, 3, 1]]
    assert torch.equal(found.semantics.camera_mask, found.semantics.lidar_mask)
    assert found.instances.track_id[:, 4].nonzero().tolist() == [[0, 1, 6], [1, 2, 6]]


def test_mirrored_twice_is_as_before(example: Example) -> None:
    both = torch.ones(2, dtype=torch.bool)
    found = mirrored(mirrored(example, both), both).truth
    assert found is not None
    assert found.elements is not None
    assert found.instances is not None
    assert torch.equal(found.elements.vertices, truth().elements.vertices)
    assert torch.equal(found.instances.track_id, truth().instances.track_id)


def test_a_raster_that_is_not_symmetric_is_refused(example: Example) -> None:
    aside = dataclasses.replace(example, truth=truth(PlaneSpec((-2.0, -0.5), 0.5, (4, 8))))
    with pytest.raises(InputError, match="symmetric about y = 0"):
        mirrored(aside, torch.ones(2, dtype=torch.bool))
