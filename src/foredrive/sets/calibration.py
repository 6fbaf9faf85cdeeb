"""Calibration of existence probabilities and of covariances, after training."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Shaped
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets.boxes import BoxDensity, LabelledBoxes
from foredrive.sets.likelihood import set_nll
from foredrive.sets.processes import MultiBernoulli, PoissonMultiBernoulli, PoissonProcess


@dataclass(frozen=True)
class ExistenceMap:
    """An increasing, piecewise linear map from predicted to calibrated probabilities."""

    predicted: Float[ndarray, "n"]
    calibrated: Float[ndarray, "n"]

    def __call__(self, probability: Float[ndarray, "m"]) -> Float[ndarray, "m"]:
        """Return the calibrated probabilities."""
        return np.interp(probability, self.predicted, self.calibrated)


def fit_existence(probability: Float[ndarray, "n"], happened: Shaped[ndarray, "n"]) -> ExistenceMap:
    """Fit the outcomes to the predicted probabilities by isotonic regression.

    `happened` may hold probabilities, such as 1 - `AssociationSum.absent`. The fitted values keep a distance
    of half an observation from 0 and 1, so that no likelihood becomes zero.
    """
    from scipy.optimize import isotonic_regression  # not on every machine with a GPU

    if len(probability) == 0:
        raise InputError("calibration of existence needs detections")
    order = np.argsort(probability, kind="stable")
    # Equal predictions share one value, weighted by their number
    predicted, which = np.unique(probability[order], return_inverse=True)
    count = np.bincount(which)
    mean = np.bincount(which, np.asarray(happened, dtype=float)[order]) / count
    # Isotonic regression: the closest increasing sequence
    fitted = isotonic_regression(mean, weights=count.astype(float)).x
    margin = 0.5 / len(probability)
    return ExistenceMap(predicted, np.clip(fitted, margin, 1 - margin))


def whiten(boxes: BoxDensity, objects: LabelledBoxes) -> Float[ndarray, "n D"]:
    """Return L⁻¹(state - mean) of box i under density i."""
    with torch.no_grad():
        offset = (objects.state.double() - boxes.mean.double())[..., None]
        return torch.linalg.solve_triangular(boxes.chol.double(), offset, upper=False)[..., 0].cpu().numpy()


def fit_scale(boxes: BoxDensity, objects: LabelledBoxes, weight: Float[ndarray, "n"] | None = None) -> float:
    """Return the factor on standard deviations that maximises the likelihood of box i under density i.

    The weights may be association probabilities.
    """
    white = whiten(boxes, objects)
    weight = np.ones(len(white)) if weight is None else weight
    if not weight.sum() > 0:
        raise InputError("calibration of covariances needs detections that have an object")
    # Maximum likelihood: root mean square for normal, √2 times the mean absolute value for Laplace
    if boxes.family == "gaussian":
        return math.sqrt(float(weight @ (white**2).mean(1) / weight.sum()))
    return math.sqrt(2) * float(weight @ np.abs(white).mean(1) / weight.sum())


@dataclass(frozen=True)
class SetCalibration:
    """Calibration of the existence probabilities and the standard deviations of a detector."""

    existence: ExistenceMap
    std_factor: float

    def __call__(self, detected: MultiBernoulli) -> MultiBernoulli:
        """Return the detections with calibrated existence and covariance."""
        # Existence by the map, covariance by the factor on L
        r = torch.as_tensor(self.existence(detected.log_existence.exp().cpu().numpy()))
        r = r.to(detected.log_existence)
        boxes = dataclasses.replace(detected.boxes, chol=detected.boxes.chol * self.std_factor)
        return dataclasses.replace(detected, log_existence=r.log(), log_absence=torch.log1p(-r), boxes=boxes)


def fit_set_calibration(
    detected: Sequence[MultiBernoulli], objects: Sequence[LabelledBoxes], background: PoissonProcess
) -> SetCalibration:
    """Fit isotonic existence and one factor on standard deviations, on frames outside the training set.

    Detections are matched by the associations of each frame. Objects without a detection belong to
    `background`.
    """
    existence, has_object, boxes, paired = [], [], [], []
    for found_boxes, truth in zip(detected, objects, strict=True):
        # Associations of the frame under the detector's own densities
        pairs = set_nll(PoissonMultiBernoulli(found_boxes, background), truth).associations
        existence.append(found_boxes.log_existence.exp().cpu().numpy())
        has_object.append(1.0 - pairs.absent)
        # Scales are fitted on the most likely pairs only
        has = np.flatnonzero(pairs.best >= 0)
        boxes.append(found_boxes.boxes[pairs.best[has]])
        paired.append(truth[has])
    if not existence:
        raise InputError("calibration needs frames")
    factor = fit_scale(
        BoxDensity(
            torch.cat([part.mean for part in boxes]),
            torch.cat([part.chol for part in boxes]),
            family=boxes[0].family,
        ),
        LabelledBoxes(torch.cat([o.label for o in paired]), torch.cat([o.state for o in paired])),
    )
    return SetCalibration(fit_existence(np.concatenate(existence), np.concatenate(has_object)), factor)


def conformal_factor(boxes: BoxDensity, objects: LabelledBoxes, coverage: float) -> float:
    """Return q such that mean ± q·σ contains a new object with probability ≥ `coverage`.

    All coordinates must be inside. This is split conformal prediction with the largest |error| / σ as score.
    It is valid for any distribution if the new pairs are exchangeable with these. Return +inf if there are
    too few pairs.
    """
    score = np.sort(conformal_scores(boxes, objects))
    # Rank of the score with the finite-sample correction of split conformal prediction
    rank = math.ceil((len(score) + 1) * coverage)
    return float(score[rank - 1]) if 1 <= rank <= len(score) else math.inf


def conformal_scores(boxes: BoxDensity, objects: LabelledBoxes) -> Float[ndarray, "n"]:
    """Return the largest |error| / σ over the coordinates of box i."""
    with torch.no_grad():
        error = (objects.state.double() - boxes.mean.double()).abs()
        # Standard deviation of a coordinate: norm of its row of L
        std = boxes.chol.double().square().sum(-1).sqrt()
        return (error / std).amax(-1).cpu().numpy()
