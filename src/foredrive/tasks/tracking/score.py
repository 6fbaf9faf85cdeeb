"""Figures of tracks under every protocol, by flat keys."""

import math
from collections.abc import Mapping

from foredrive.engine.summary import Figures
from foredrive.tasks.objects.object_rows import Frames, ObjectRows
from foredrive.tasks.objects.truth import FoundObjects, ObjectTruth, count_objects
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS, evaluate_tracking

_TRACKING_NAMES = {
    "amotp": "amotp_m",
    "motp": "motp_m",
    "faf": "faf_per_100_frames",
    "tid": "tid_s",
    "lgd": "lgd_s",
}
"""The devkit's names of figures with a unit, with it."""


def score_tracks(predicted: FoundObjects, truth: ObjectTruth) -> Figures:
    """Return the figures of tracks under every protocol; None where nothing can be counted."""
    figures = tracking_figures(predicted.boxes, truth.boxes, truth.racks, truth.frames)
    return count_objects(predicted, truth) | {f"tracking.{key}": value for key, value in figures.items()}


def tracking_figures(predicted: ObjectRows, true: ObjectRows, racks: ObjectRows, frames: Frames) -> Figures:
    """Return `nuscenes.amota`, `nuscenes.car.ids`, `uniad.amota`, … of tracks.

    Args:
        predicted, true: labels are indices into nuScenes' seven classes.
        racks: bicycle racks, in which bicycles do not count.
        frames: all frames, in the order of time within each scene.
    """
    figures: Figures = {}
    for name, protocol in TRACKING_PROTOCOLS.items():
        scored = evaluate_tracking(predicted, true, racks, frames, protocol)
        figures |= _prefixed(name, scored.all_classes)
        for label, values in scored.by_class.items():
            # Classes without ground truth have no figures
            if values["gt"] > 0:
                figures |= _prefixed(f"{name}.{label}", values)
    return figures


def _prefixed(prefix: str, values: Mapping[str, float]) -> Figures:
    return {
        f"{prefix}.{_TRACKING_NAMES.get(key, key)}": None if math.isnan(value) else value
        for key, value in values.items()
    }
