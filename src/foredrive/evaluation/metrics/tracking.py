"""Identities of detected road users over time, beside those of a simple tracker."""

import numpy as np

from foredrive.evaluation.frame_keys import continues, time_of
from foredrive.evaluation.metric import EvaluationContext, Figures
from foredrive.evaluation.objects.greedy_tracks import greedy_tracks
from foredrive.evaluation.objects.in_world import agent_rows, box_rows, likely, stacked
from foredrive.evaluation.objects.score import tracking_figures
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.object_rows import Frames, ObjectRows
from foredrive.metrics.tracking.protocols import TRACKING_PROTOCOLS
from foredrive.scene import Example

CLASSES = TRACKING_PROTOCOLS["nuscenes"].classes
BASELINE = ".greedy_association"


class TrackingMetric:
    """Keys: `nuscenes.amota`, `nuscenes.amotp_m`, `nuscenes.ids`, `nuscenes.car.ids`, `uniad.amota`, ….

    The keys of the baseline end in `.greedy_association`: the same detections with the identities of
    `greedy_tracks`. A model whose agents have no identities has the baseline's figures alone. Frames without
    annotation do not count. A drive is cut where frames are missing, and each part is a scene of its own.
    """

    name = "tracking"
    needs: frozenset[Part] = frozenset({"agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._found: list[ObjectRows] = []
        self._true: list[ObjectRows] = []
        self._scene: list[int] = []
        self._keys: list[str] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips, which follow those of the last call."""
        assert prediction.agents is not None
        clip = truth.clip
        for item in clip.boxes_valid[:, clip.now].nonzero()[:, 0].tolist():
            frame, key = len(self._keys), truth.key[item]
            pose = clip.T_world_ego[item, clip.now].cpu().numpy()
            self._found.append(agent_rows(likely(prediction.agents[item]), pose, frame, CLASSES))
            self._true.append(box_rows(clip.boxes[item, clip.now], pose, frame, CLASSES))
            scene = self._scene[-1] if self._scene else 0
            goes_on = not self._keys or continues(self._keys[-1], key)
            self._scene.append(scene if goes_on else scene + 1)
            self._keys.append(key)

    def result(self) -> Figures:
        """Return the figures over all annotated frames."""
        if not self._keys:
            return {"frames_counted": 0}
        found, true = stacked(self._found), stacked(self._true)
        times = np.array([time_of(key) for key in self._keys], dtype=np.int64)
        frames = Frames(np.array(self._scene, dtype=np.int64), times)
        out: Figures = {"frames_counted": len(frames), "scenes": self._scene[-1] + 1}
        if (found.track >= 0).any():
            out |= tracking_figures(found[found.track >= 0], true, true[:0], frames)
        simple = tracking_figures(greedy_tracks(found, frames, CLASSES), true, true[:0], frames)
        return out | {f"{key}{BASELINE}": value for key, value in simple.items()}
