"""Detected road users under the protocols of nuScenes and VAD, beside detecting nothing."""

import dataclasses

import numpy as np

from foredrive.scene import Example
from foredrive.tasks.detection.figures import detection_figures
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS, evaluate_detections
from foredrive.tasks.metric import CEILING, EvaluationContext, Figures, Shown
from foredrive.tasks.objects.in_world import agent_rows, box_rows, likely, stacked
from foredrive.tasks.objects.object_rows import DETECTION_CLASSES, ObjectRows, Region
from foredrive.tasks.objects.truth import lacking
from foredrive.tasks.predictor import Part, Prediction

CAR_30M = dataclasses.replace(
    DETECTION_PROTOCOLS["nuscenes"],
    title="cars within 30 m",
    classes=("car",),
    region=Region("circle", {"car": (30.0, 30.0)}),
)


class DetectionMetric:
    """Keys: `nuscenes.map`, `nuscenes.nds`, `nuscenes.ate_m`, `vad.map`, `car_ap_2m_30m`, `frames_counted`.

    `nuscenes.map.ceiling` and `car_ap_2m_30m.ceiling` are those of the true boxes above the clips' voxels.
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
        self._above: list[ObjectRows] = []
        """True boxes above the voxels."""

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        assert prediction.agents is not None
        clip = truth.clip
        for item in clip.boxes_valid[:, clip.now].nonzero()[:, 0].tolist():
            frame = len(self._true)
            # World coordinates, as in files of results
            pose = clip.T_world_ego[item, clip.now].cpu().numpy()
            self._found.append(agent_rows(likely(prediction.agents[item]), pose, frame, DETECTION_CLASSES))
            boxes = clip.boxes[item, clip.now]
            self._true.append(box_rows(boxes, pose, frame, DETECTION_CLASSES))
            # Boxes without a point do not count, so finding them would be wrong
            shown = boxes.valid & truth.occupancy.spec.covers(boxes.centre) & (boxes.num_points != 0)
            self._above.append(
                box_rows(dataclasses.replace(boxes, valid=shown), pose, frame, DETECTION_CLASSES)
            )

    def result(self) -> Figures:
        """Return the figures over all annotated frames."""
        if not self._true:
            return {"frames_counted": 0}
        predicted, true, above = stacked(self._found), stacked(self._true), stacked(self._above)
        above = dataclasses.replace(above, score=np.ones(len(above)))
        # Baseline: no detections at all
        none = np.zeros(0, dtype=np.int64)
        nothing, racks, lacks = predicted[none], true[none], lacking(true)
        out = detection_figures(predicted, true, racks, lacks)
        empty = detection_figures(nothing, true, racks, lacks)
        best = detection_figures(above, true, racks, lacks)
        for name in DETECTION_PROTOCOLS:
            out |= {f"{name}.{key}.nothing_detected": empty[f"{name}.{key}"] for key in ("map", "nds")}
            out[f"{name}.map.{CEILING}"] = best[f"{name}.map"]
        # Label 0 is the first class, cars
        cars = true[true.label == 0]
        for rows, suffix in ((predicted, ""), (above, f".{CEILING}")):
            cars_figures = evaluate_detections(rows[rows.label == 0], cars, racks, CAR_30M).by_class["car"]
            out[f"car_ap_2m_30m{suffix}"] = cars_figures.ap[2.0] if cars_figures.true else float("nan")
        out["car_ap_2m_30m.nothing_detected"] = 0.0
        return out | {"car_ap_2m_30m.true": cars_figures.true, "frames_counted": len(self._true)}
