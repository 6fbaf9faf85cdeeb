"""Semantic voxels under the protocols of Occ3D and OpenOcc, beside the commonest class of each voxel."""

from foredrive.scene import Example
from foredrive.tasks.metric import PRIOR, EvaluationContext, Figures, Shown
from foredrive.tasks.occupancy.of_logs import LogVoxelCounts
from foredrive.tasks.predictor import Part, Prediction

BESIDE_PRIOR = ("miou_pct", "rayiou_pct", "rayiou_1m_pct", "rayiou_2m_pct", "rayiou_4m_pct", "occ_score")
"""Figures that the prior has, too."""


class SemanticVoxelMetric:
    """Keys: `occ3d.miou_pct`, `occ3d.rayiou_1m_pct`, `openocc.occ_score`, `….best_constant`, and so on.

    The grid is that of the clips, not Occ3D's, so figures compare only models on the same grid. Voxels
    without truth do not count, neither do frames without any. Velocities are the model's flow at now; a
    model without flow, and the prior, stand still.
    """

    name = "occupancy"
    title = "Voxels"
    shown: tuple[Shown, ...] = (
        Shown("mIoU, camera mask, %", "occ3d.miou_pct", PRIOR),
        Shown("mIoU, lidar mask, %", "occ3d_lidar.miou_pct", PRIOR),
        Shown("mIoU, all voxels, %", "occ3d_unmasked.miou_pct", PRIOR),
        Shown("RayIoU, %", "occ3d.rayiou_pct", PRIOR),
        Shown("RayIoU at 1 m, %", "occ3d.rayiou_1m_pct", PRIOR),
        Shown("RayIoU at 2 m, %", "occ3d.rayiou_2m_pct", PRIOR),
        Shown("RayIoU at 4 m, %", "occ3d.rayiou_4m_pct", PRIOR),
        Shown("OpenOcc's OccScore", "openocc.occ_score", PRIOR),
    )
    needs: frozenset[Part] = frozenset({"semantics"})

    def __init__(self, context: EvaluationContext) -> None:
        prior = None if context.task_priors is None else context.task_priors.semantics
        self._prior = None if prior is None else prior.cpu().numpy()
        self._counts: dict[str, LogVoxelCounts] = {}

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        predicted, semantics = prediction.semantics, None if truth.truth is None else truth.truth.semantics
        if predicted is None or semantics is None or truth.truth is None:
            return
        # Frames with any known voxel
        for item in semantics.known.flatten(1).any(dim=1).nonzero()[:, 0].tolist():
            true = semantics[item].to("cpu")
            rays = None if truth.truth.rays is None else truth.truth.rays[item].to("cpu")
            flow = None if prediction.flow_mps is None else prediction.flow_mps[item, 0, :2].cpu().numpy()
            shown = {"": (predicted[item].cpu().numpy(), flow)}
            # The prior stands still
            if self._prior is not None:
                shown[f".{PRIOR}"] = (self._prior, None)
            for suffix, (voxels, velocity_mps) in shown.items():
                counts = self._counts.setdefault(suffix, LogVoxelCounts(true.taxonomy, true.spec))
                counts.add(voxels, velocity_mps, true, rays)

    def result(self) -> Figures:
        """Return the figures over all frames."""
        out: Figures = {}
        for suffix, counts in self._counts.items():
            for key, value in counts.figures().items():
                if not suffix or key.split(".")[-1] in BESIDE_PRIOR:
                    out[f"{key}{suffix}"] = value
        return out
