"""Typical lines of a training set, at which the map elements of fresh heads start."""

import pytest
import torch
from joint_heads import small_heads

from foredrive.heads.heads import TaskHeads
from foredrive.runs.train.task_priors import place_map_elements, typical_lines
from foredrive.scene import VoxelSpec
from foredrive.scene.map_elements import ElementKind, MapElements
from foredrive.scene.task_truth import TaskTruth

GRID = VoxelSpec((-16.0, -16.0, -1.0), 2.0, (2, 16, 16))


def truth(offset_m: float, backwards: bool, known: bool = True) -> TaskTruth:
    """A divider to the left, a boundary to the right of it, and a centreline, which no head finds."""
    lines = torch.tensor(
        [[[-12.0, 4.0], [12.0, 4.0]], [[-12.0, -6.0], [12.0, -6.0]], [[-12.0, 0.0], [12.0, 0.0]]]
    )
    lines = lines + torch.tensor([0.0, offset_m])
    kinds = torch.tensor([ElementKind.DIVIDER, ElementKind.BOUNDARY, ElementKind.CENTRELINE])
    elements = MapElements(
        vertices=lines.flip(1) if backwards else lines,
        valid=torch.ones(3, 2, dtype=torch.bool),
        kind=kinds,
        known=torch.tensor(known),
    )
    return TaskTruth(elements=elements)


def test_they_are_the_middles_of_what_is_alike_in_either_direction() -> None:
    truths = [truth(offset_m, backwards=k % 2 == 1) for k, offset_m in enumerate((-0.5, 0.0, 0.2, 0.3))]
    lines = typical_lines([*truths, None, truth(50.0, False, known=False)], 2, 4, 3, seed=0)
    assert lines is not None
    lines = lines[lines[:, 0, 1].argsort()]
    assert lines[:, :, 0].tolist() == [pytest.approx([-12.0, -4.0, 4.0, 12.0])] * 2
    torch.testing.assert_close(lines[:, :, 1], torch.tensor([[-6.0], [4.0]]).expand(2, 4))


def test_fresh_heads_start_there_unless_there_are_too_few() -> None:
    recipe = small_heads(("map",))
    assert recipe.heads.elements is not None
    heads = TaskHeads(recipe.heads, GRID, channels=4, raster=recipe.truth.raster)
    assert heads.elements is not None
    spread = heads.elements.start_m.detach().clone()
    place_map_elements(heads, [truth(0.0, False)], seed=0)  # two lines for three elements
    assert torch.equal(heads.elements.start_m, spread)
    place_map_elements(heads, [truth(0.1 * k, False) for k in range(5)], seed=0)
    across_m = heads.elements.start_m[:, :, 1]
    assert bool(((across_m > -6.5) & (across_m < -5.0) | (across_m > 3.5) & (across_m < 5.0)).all())
    assert heads.elements.start_m.requires_grad
