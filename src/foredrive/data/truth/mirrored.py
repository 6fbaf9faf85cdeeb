"""Mirroring of task truth in the x-z plane of the ego vehicle."""

import dataclasses

import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene.task_truth import TaskTruth


def mirrored_truth(truth: TaskTruth, chosen: Bool[Tensor, "b"]) -> TaskTruth:
    """Return the truth of a batch in which the chosen items are mirrored. Centrelines keep their direction.

    Rays are left out: nothing is trained on them.

    Raises:
        InputError: a raster is not symmetric about y = 0.
    """
    futures, elements = truth.futures, truth.elements
    raster, semantics, instances = truth.raster, truth.semantics, truth.instances
    # Reversing the rows of a grid mirrors it only if the grid is symmetric about y = 0
    for grid in (raster, instances):
        if grid is not None and abs(grid.spec.lower_m[1] + grid.spec.upper_m[1]) > 1e-6 * grid.spec.cell_m:
            raise InputError(f"a raster is mirrored only if it is symmetric about y = 0: {grid.spec}")
    if futures is not None:
        # Mirroring changes the sign of y and of headings
        xy, yaw = _negated_y(futures.xy, chosen), _pick(chosen, -futures.yaw, futures.yaw)
        futures = dataclasses.replace(futures, xy=xy, yaw=yaw)
    if elements is not None:
        elements = dataclasses.replace(elements, vertices=_negated_y(elements.vertices, chosen))
    if raster is not None:
        raster = dataclasses.replace(raster, layers=_flipped(raster.layers, chosen))
    if instances is not None:
        instances = dataclasses.replace(instances, track_id=_flipped(instances.track_id, chosen))
    if semantics is not None:
        semantics = dataclasses.replace(
            semantics,
            index=_flipped(semantics.index, chosen),
            known=_flipped(semantics.known, chosen),
            camera_mask=_flipped(semantics.camera_mask, chosen),
            lidar_mask=_flipped(semantics.lidar_mask, chosen),
        )
    return TaskTruth(futures, elements, raster, semantics, instances)


def _negated_y(points: Shaped[Tensor, "b *n 2"], chosen: Bool[Tensor, "b"]) -> Tensor:
    return _pick(chosen, points * points.new_tensor([1.0, -1.0]), points)


def _flipped(grid: Shaped[Tensor, "b *n Y X"], chosen: Bool[Tensor, "b"]) -> Tensor:
    return _pick(chosen, grid.flip(-2), grid)


def _pick(chosen: Bool[Tensor, "b"], one: Tensor, other: Tensor) -> Tensor:
    return torch.where(chosen.view(-1, *[1] * (one.dim() - 1)), one, other)
