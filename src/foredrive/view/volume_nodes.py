"""A model's predictions as nodes of a 3-D scene: cubes of occupancy, arrows of flow."""

from typing import Literal

import numpy as np
import torch
import viser
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from viser.transforms import SO3

from foredrive.runs.evaluate.display import DisplayPrediction
from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, Taxonomy
from foredrive.view import palette
from foredrive.view.scene_nodes import clear
from foredrive.view.task_pictures import voxel_colours
from foredrive.view.voxel_drawing import height_colours, pca_colours

ColourBy = Literal["height", "features", "classes"]
BESIDE_M = 4.0
"""Distance between predicted and true voxels, m."""
FILL = 0.94
"""Edge of a drawn cube relative to its voxel; below 1, so that neighbours stay apart."""
MOVES_M = 0.25
"""Minimum length of a drawn arrow, m."""
ARROW_WIDTH, HEAD_SHARE = 3.0, 0.3

_CUBE = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_CUBE_FACES = np.array(
    [
        [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
        [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
    ]
)  # fmt: skip


def shown_voxels(
    prediction: DisplayPrediction, k: int, spec: VoxelSpec, above: float, min_height_m: float
) -> Bool[Tensor, "Z Y X"]:
    """Return the voxels of frame k that are occupied with a probability of more than `above`.

    Args:
        min_height_m: minimum height of voxel centres in the ego frame; the road would hide many other voxels.
    """
    z = spec.centres_m()[..., 2]
    return (prediction.occupancy_logit[k].sigmoid() > above) & (z >= min_height_m)


def show_occupancy(
    scene: viser.SceneApi,
    prediction: DisplayPrediction,
    k: int,
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
    colour_by: ColourBy,
) -> None:
    """Draw voxels of frame k as cubes in the ego frame now, where the model expects them.

    Classes are those of now; later frames have the colours of height instead.
    """
    colours: UInt8[np.ndarray, "Z Y X 3"] = height_colours(spec)
    if colour_by == "features":
        colours = pca_colours(prediction.volume[k], shown)
    elif colour_by == "classes" and k == 0 and prediction.classes is not None:
        colours = voxel_colours(prediction.taxonomy)[prediction.classes.numpy()]
    return _show_cubes(scene, "/occupancy", prediction.T_now_ego[k], spec, shown, colours)


def show_true_classes(
    scene: viser.SceneApi,
    classes: UInt8[Tensor, "Z Y X"] | None,
    taxonomy: Taxonomy,
    spec: VoxelSpec,
    min_height_m: float,
) -> None:
    """Draw the recorded voxels of now in the colours of their classes, to the left of the scene."""
    if classes is None:
        return clear(scene, "/true voxels")
    shown = (classes != len(VOXEL_CLASSES[taxonomy]) - 1) & (spec.centres_m()[..., 2] >= min_height_m)
    beside = torch.eye(4)
    beside[1, 3] = spec.upper_m[1] - spec.lower_m[1] + BESIDE_M
    return _show_cubes(scene, "/true voxels", beside, spec, shown, voxel_colours(taxonomy)[classes.numpy()])


def _show_cubes(
    scene: viser.SceneApi,
    name: str,
    T_now_ego: Float[Tensor, "4 4"],
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
    colours: UInt8[np.ndarray, "Z Y X 3"],
) -> None:
    pose, count = T_now_ego.double().numpy(), int(shown.sum())
    if count == 0:
        return clear(scene, name)
    scene.add_batched_meshes_simple(
        name,
        FILL * spec.voxel_m * _CUBE,
        _CUBE_FACES,
        batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        batched_positions=spec.centres_m()[shown].numpy(),
        batched_colors=colours[shown.numpy()],
        flat_shading=True,
        lod="off",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
        position=pose[:3, 3],
    )
    return None


def show_flow(
    scene: viser.SceneApi,
    prediction: DisplayPrediction,
    k: int,
    spec: VoxelSpec,
    shown: Bool[Tensor, "Z Y X"],
) -> None:
    """Draw the movement of shown voxels since frame k - 1 as arrows over the ground; none for now."""
    movement = None if k == 0 else prediction.movement_m(k, spec)
    if movement is None:
        return clear(scene, "/flow")
    start, end = movement
    moves = shown & ((end - start).norm(dim=-1) > MOVES_M)
    if not bool(moves.any()):
        return clear(scene, "/flow")
    ends = arrows(start[moves], end[moves])
    lift = torch.tensor([0.0, 0.0, 0.75 * spec.voxel_m])  # on top of the cubes, not inside
    scene.add_line_segments(
        "/flow",
        (ends + lift).numpy(),
        np.array(palette.rgb255(palette.FALSE_POSITIVE)),
        line_width=ARROW_WIDTH,
    )
    return None


def arrows(start: Float[Tensor, "N 3"], end: Float[Tensor, "N 3"]) -> Float[Tensor, "N3 2 3"]:
    """Return three segments for each of N arrows with flat heads, the shaft first."""
    along = end - start
    across = torch.stack([-along[:, 1], along[:, 0], torch.zeros_like(along[:, 0])], dim=-1)
    back = end - HEAD_SHARE * along
    heads = [back + 0.5 * HEAD_SHARE * across, back - 0.5 * HEAD_SHARE * across]
    return torch.stack([torch.stack([start, *heads], 1), end[:, None].expand(-1, 3, 3)], 2).flatten(0, 1)
