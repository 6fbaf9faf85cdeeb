"""Detected road users under the protocols of nuScenes and VAD, beside detecting nothing."""

import dataclasses

import numpy as np

from foredrive.scene import Example
from foredrive.tasks.detection.protocols import CLASSES, DETECTION_PROTOCOLS, evaluate_detections
from foredrive.tasks.evaluation.metric import EvaluationContext, Figures, Shown
from foredrive.tasks.evaluation.predictor import Part, Prediction
from foredrive.tasks.tracking.in_world import agent_rows, box_rows, likely, stacked
from foredrive.tasks.tracking.object_rows import ObjectRows, Region
from foredrive.tasks.tracking.score import detection_figures
from foredrive.tasks.tracking.truth import lacking

CAR_30M = dataclasses.replace(
    DETECTION_PROTOCOLS["nuscenes"],
    title="cars within 30 m",
    classes=("car",),
    region=Region("circle", {"car": (30.0, 30.0)}),
)


class DetectionMetric:
    """Keys: `nuscenes.map`, `nuscenes.nds`, `nuscenes.ate_m`, `vad.map`, `car_ap_2m_30m`, `frames_counted`.

    Frames without annotation do not count. Boxes are compared in the world frame, as in files of results.
    Figures that need a value that no true box has, such as an attribute, are None.
    """

    name = "detection"
    title = "Detection"
    shown: tuple[Shown, ...] = (
        Shown("nuScenes mAP", "nuscenes.map", "nothing_detected"),
        Shown("NDS", "nuscenes.nds", "nothing_detected"),
        Shown("AP of cars, 2 m, within 30 m", "car_ap_2m_30m", "nothing_detected"),
    )
    needs: frozenset[Part] = frozenset({"agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._found: list[ObjectRows] = []
        self._true: list[ObjectRows] = []

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        assert prediction.agents is not None
        clip = truth.clip
        for item in clip.boxes_valid[:, clip.now].nonzero()[:, 0].tolist():
            frame = len(self._true)
            # World coordinates, as in files of results
            pose = clip.T_world_ego[item, clip.now].cpu().numpy()
            self._found.append(agent_rows(likely(prediction.agents[item]), pose, frame, CLASSES))
            self._true.append(box_rows(clip.boxes[item, clip.now], pose, frame, CLASSES))

    def result(self) -> Figures:
        """Return the figures over all annotated frames."""
        if not self._true:
            return {"frames_counted": 0}
        predicted, true = stacked(self._found), stacked(self._true)
        # Baseline: no detections at all
        none = np.zeros(0, dtype=np.int64)
        nothing, racks, lacks = predicted[none], true[none], lacking(true)
        out = detection_figures(predicted, true, racks, lacks)
        empty = detection_figures(nothing, true, racks, lacks)
        for key in ("map", "nds"):
            out |= {f"{name}.{key}.nothing_detected": empty[f"{name}.{key}"] for name in DETECTION_PROTOCOLS}
        # Label 0 is the first class, cars
        cars = [rows[rows.label == 0] for rows in (predicted, true)]
        figures = evaluate_detections(cars[0], cars[1], racks, CAR_30M).by_class["car"]
        out |= {"car_ap_2m_30m": figures.ap[2.0] if figures.true else float("nan")}
        out["car_ap_2m_30m.nothing_detected"] = 0.0
        return out | {"car_ap_2m_30m.true": figures.true, "frames_counted": len(self._true)}
