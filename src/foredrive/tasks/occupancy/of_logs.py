"""Semantic voxels judged by logs: the truth of a frame, and a prediction, in the classes of each data set."""

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

from foredrive.engine.summary import Figures
from foredrive.scene import VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, RayTruth, SemanticVoxels, Taxonomy
from foredrive.tasks.occupancy.files import VoxelFrame
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, OPENOCC_CLASSES
from foredrive.tasks.occupancy.score import VoxelCounts

_OCC3D_OTHERS, _OPENOCC_FREE = OCC3D_CLASSES.index("others"), len(OPENOCC_CLASSES) - 1
_AS_OPENOCC = np.array(
    [OPENOCC_CLASSES.index(name) if name in OPENOCC_CLASSES else _OPENOCC_FREE for name in OCC3D_CLASSES],
    dtype=np.uint8,
)
"""Class of OpenOcc by that of Occ3D. OpenOcc has no class for "others", which is free in a prediction."""


class LogVoxelCounts:
    """Counts of frames in the classes in which they are predicted, and in those of OpenOcc.

    The grid is that of the log's truth, not Occ3D's, so figures compare only models on the same grid.

    Args:
        taxonomy: classes of prediction and truth.
        spec: their grid.
    """

    def __init__(self, taxonomy: Taxonomy, spec: VoxelSpec) -> None:
        self._own = VoxelCounts(taxonomy, spec)
        self._openocc = None if taxonomy == "openocc" else VoxelCounts("openocc", spec)

    def add(
        self,
        predicted: UInt8[ndarray, "Z Y X"],
        velocity_mps: Float[ndarray, "2 Z Y X"] | None,
        truth: SemanticVoxels,
        rays: RayTruth | None,
    ) -> None:
        """Add an unbatched frame. Predictions without velocities stand still, and so does free space."""
        frame = _frame(predicted, velocity_mps, truth, rays)
        origins_m = None if rays is None else rays.origin_m[rays.origin_valid].double().numpy()
        self._own.add(frame, origins_m)
        # The same frame also in OpenOcc's classes
        if self._openocc is not None:
            self._openocc.add(_as_openocc(frame), origins_m)

    def figures(self) -> Figures:
        """Return the figures by `PROTOCOL.KEY`; single classes under the data sets' own protocols alone."""
        figures = self._own.figures() | ({} if self._openocc is None else self._openocc.figures())
        own = (self._own.data_set, "openocc")
        return {
            key: value for key, value in figures.items() if key.count(".") < 2 or key.split(".")[0] in own
        }


def _frame(
    predicted: UInt8[ndarray, "Z Y X"],
    velocity_mps: Float[ndarray, "2 Z Y X"] | None,
    truth: SemanticVoxels,
    rays: RayTruth | None,
) -> VoxelFrame:
    true_mps = None if rays is None else _last(rays.velocity_mps)
    # Free voxels stand still
    predicted_mps = None
    if true_mps is not None:
        occupied = predicted[..., None] != len(VOXEL_CLASSES[truth.taxonomy]) - 1
        stated = np.zeros_like(true_mps) if velocity_mps is None else _last(velocity_mps)
        predicted_mps = np.where(occupied, stated, np.float32(0.0))
    return VoxelFrame(
        predicted,
        truth.index.numpy(),
        truth.camera_mask.numpy(),
        truth.lidar_mask.numpy(),
        predicted_mps,
        true_mps,
        states_velocity=velocity_mps is not None,
        known=truth.known.numpy(),
    )


def _as_openocc(frame: VoxelFrame) -> VoxelFrame:
    """Return a frame of Occ3D's classes in those of OpenOcc. Where the truth has none, nothing is known."""
    # "others" has no class in OpenOcc: unknown in the truth, free in a prediction
    assert frame.known is not None
    known: Bool[ndarray, "Z Y X"] = frame.known & (frame.true != _OCC3D_OTHERS)
    return VoxelFrame(
        _AS_OPENOCC[frame.predicted],
        _AS_OPENOCC[frame.true],
        frame.seen_by_camera,
        frame.seen_by_lidar,
        frame.predicted_mps,
        frame.true_mps,
        frame.states_velocity,
        known,
    )


def _last(velocity: Tensor | Float[ndarray, "2 Z Y X"]) -> Float32[ndarray, "Z Y X 2"]:
    """Return velocities with their components last."""
    return np.ascontiguousarray(np.moveaxis(np.asarray(velocity, dtype=np.float32), 0, -1))
