"""Semantic voxels under the masks of Occ3D or OpenOcc, beside the commonest class of each voxel."""

import numpy as np
from numpy import ndarray

from foredrive.evaluation.metric import EvaluationContext, Figures
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.voxels.protocols import VOXEL_PROTOCOLS
from foredrive.metrics.voxels.semantic import count_voxels, mean_iou, voxel_ious
from foredrive.scene import Example
from foredrive.scene.semantics import VOXEL_CLASSES

PRIOR = ".best_constant"


class SemanticVoxelMetric:
    """Keys: `occ3d.miou_pct`, `occ3d_unmasked.miou_pct`, `….miou_pct.best_constant`, `….frames_counted`.

    The grid is that of the clips, not Occ3D's, so figures compare only models on the same grid. Voxels
    without truth do not count, neither do frames without any.
    """

    name = "occupancy"
    needs: frozenset[Part] = frozenset({"semantics"})

    def __init__(self, context: EvaluationContext) -> None:
        self._prior = None if context.task_priors is None else context.task_priors.semantics
        self._counts: dict[str, ndarray] = {}
        self._classes: tuple[str, ...] = ()
        self._frames = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        found, semantics = prediction.semantics, None if truth.truth is None else truth.truth.semantics
        if found is None or semantics is None:
            return
        self._classes = VOXEL_CLASSES[semantics.taxonomy]
        for item in semantics.known.flatten(1).any(dim=1).nonzero()[:, 0].tolist():
            true = semantics[item].to("cpu")
            shown = {"": found[item].cpu().numpy()}
            if self._prior is not None:
                shown[PRIOR] = self._prior.cpu().numpy()
            known = true.known.numpy()
            index, camera, lidar = (
                _as_grid(grid.numpy()[known]) for grid in (true.index, true.camera_mask, true.lidar_mask)
            )
            for suffix, voxels in shown.items():
                predicted = _as_grid(voxels[known])
                counts = count_voxels(predicted, index, camera, lidar, len(self._classes))
                self._counts[suffix] = self._counts.get(suffix, np.zeros_like(counts)) + counts
            self._frames += 1

    def result(self) -> Figures:
        """Return the mean IoU over all frames under every mask, percent."""
        out: Figures = {}
        for name, protocol in VOXEL_PROTOCOLS.items():
            if protocol.classes != self._classes:
                continue
            for suffix, counts in self._counts.items():
                out[f"{name}.miou_pct{suffix}"] = 100 * mean_iou(voxel_ious(counts, protocol))
            out[f"{name}.frames_counted"] = self._frames
        return out


def _as_grid(voxels: ndarray) -> ndarray:
    """Return a list of voxels as a grid of one row."""
    return voxels[None, None]
