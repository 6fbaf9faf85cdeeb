"""Flow of moving voxels, beside predicting no motion."""

from foredrive.scene import Example
from foredrive.tasks.metric import EvaluationContext, Figures, Shown, labels_from_now
from foredrive.tasks.occupancy.scores import FlowErrors, flow_errors
from foredrive.tasks.predictor import Part, Prediction


class FlowMetric:
    """End-point errors. Keys: `epe_moving_now_mps` and `epe_moving_now_mps.no_motion`."""

    name = "flow"
    title = "Flow"
    shown: tuple[Shown, ...] = ()
    needs: frozenset[Part] = frozenset({"flow_mps"})

    def __init__(self, context: EvaluationContext) -> None:
        self._context = context
        self._errors: FlowErrors | None = None

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add the errors of b clips.

        Raises:
            InputError: if the clips end before the predicted flow.
        """
        assert prediction.flow_mps is not None
        # Labels from now on, as many frames as are predicted
        labels = labels_from_now(truth.flow, truth.clip, prediction.flow_mps.shape[1])
        errors = flow_errors(prediction.flow_mps, labels)
        self._errors = errors if self._errors is None else self._errors + errors

    def result(self) -> Figures:
        """Return the mean errors over moving voxels."""
        if self._errors is None:
            return {}
        out: Figures = {}
        for k, name in enumerate(self._context.frame_names(len(self._errors.voxels))):
            voxels = self._errors.voxels[k]
            out[f"epe_moving_{name}_mps"] = float(self._errors.error_mps[k] / voxels)
            out[f"epe_moving_{name}_mps.no_motion"] = float(self._errors.speed_mps[k] / voxels)
        return out
