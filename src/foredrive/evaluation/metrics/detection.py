"""Detected road users under the protocols of nuScenes and VAD, beside detecting nothing."""

import dataclasses

import numpy as np
from numpy import ndarray

from foredrive.evaluation.metric import EvaluationContext, Figures
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.metrics.detection_protocols import (
    CLASSES,
    DETECTION_PROTOCOLS,
    DetectionFigures,
    evaluate_detections,
)
from foredrive.metrics.object_rows import ObjectRows, Region, make_rows
from foredrive.scene import Boxes, Category, Example
from foredrive.scene.agents import Agents

CAR_30M = dataclasses.replace(
    DETECTION_PROTOCOLS["nuscenes"],
    title="cars within 30 m",
    classes=("car",),
    region=Region("circle", {"car": (30.0, 30.0)}),
)
MIN_SCORE = 0.01
"""Detections with a lower score are left out. They change no figure by more than this."""
_LABEL = {Category[name.upper()]: label for label, name in enumerate(CLASSES)}


class DetectionMetric:
    """Keys: `nuscenes.map`, `nuscenes.nds`, `nuscenes.ate_m`, `vad.map`, `car_ap_2m_30m`, `frames_counted`.

    Frames without annotation do not count.
    """

    name = "detection"
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
            self._found.append(_found_rows(prediction.agents[item].to("cpu"), frame))
            self._true.append(_true_rows(clip.boxes[item, clip.now].to("cpu"), frame))

    def result(self) -> Figures:
        """Return the figures over all annotated frames."""
        if not self._true:
            return {"frames_counted": 0}
        found, true = _stacked(self._found), _stacked(self._true)
        none = np.zeros(0, dtype=np.int64)
        nothing, racks = found[none], true[none]
        out: Figures = {}
        for name, protocol in DETECTION_PROTOCOLS.items():
            out |= _named(name, evaluate_detections(found, true, racks, protocol), "")
            empty = evaluate_detections(nothing, true, racks, protocol)
            out |= {f"{name}.map.nothing_detected": empty.mean_ap, f"{name}.nds.nothing_detected": empty.nds}
        cars = [rows[rows.label == 0] for rows in (found, true)]
        figures = evaluate_detections(cars[0], cars[1], racks, CAR_30M).by_class["car"]
        out |= {"car_ap_2m_30m": figures.ap[2.0] if figures.true else float("nan")}
        out["car_ap_2m_30m.nothing_detected"] = 0.0
        return out | {"car_ap_2m_30m.true": figures.true, "frames_counted": len(self._true)}


def _named(protocol: str, figures: DetectionFigures, suffix: str) -> Figures:
    out: Figures = {f"{protocol}.map{suffix}": figures.mean_ap, f"{protocol}.nds{suffix}": figures.nds}
    return out | {f"{protocol}.{key}{suffix}": value for key, value in figures.errors.items()}


def _found_rows(agents: Agents, frame: int) -> ObjectRows:
    kept = agents.score >= MIN_SCORE
    chosen = agents.map_tensors(lambda tensor: tensor[kept])
    return make_rows(
        *_columns(chosen, frame),
        velocity=chosen.velocity.double().numpy(),
        attribute=chosen.attribute.numpy(),
        score=chosen.score.double().numpy(),
        from_ego=chosen.centre[:, :2].double().numpy(),
    )


def _true_rows(boxes: Boxes, frame: int) -> ObjectRows:
    chosen = boxes[boxes.valid]
    return make_rows(
        *_columns(chosen, frame),
        velocity=chosen.velocity.double().numpy(),
        attribute=chosen.attribute.numpy(),
        num_points=chosen.num_points.numpy(),
        from_ego=chosen.centre[:, :2].double().numpy(),
        track=chosen.track_id.numpy(),
    )


def _columns(objects: Agents | Boxes, frame: int) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray]:
    label = [_LABEL.get(Category(kind), -1) for kind in objects.category.tolist()]
    return (
        np.full(len(label), frame),
        np.array(label, dtype=np.int64),
        objects.centre.double().numpy(),
        objects.size_lwh.double().numpy(),
        objects.yaw.double().numpy(),
    )


def _stacked(rows: list[ObjectRows]) -> ObjectRows:
    columns = {name: np.concatenate([vars(each)[name] for each in rows]) for name in vars(rows[0])}
    return ObjectRows(**columns)
