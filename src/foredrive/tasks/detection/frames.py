"""Detections and truth by frame, as every file of detections is read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from foredrive.errors import InputError
from foredrive.sets import BoxDensity, Family, LabelledBoxes, MultiBernoulli
from foredrive.tasks.files.plain_files import read_numbers

MIN_PROBABILITY = 1e-6
"""Distance that probabilities of files are kept from 0 and 1: an exact 0 or 1 is mostly due to rounding."""
STD_M = (0.5, 0.5, 0.3)
"""Standard deviations of a box centre where a detector states none."""
STD_LOG_SIZE = 0.15
STD_YAW_RAD = 0.2
STD_OF_SIDE = 0.05
"""Standard deviation of an image box's edge where a detector states none: this share of the side across …"""
STD_PX = 1.0
"""… and this, in quadrature."""
MIN_STD_YAW_RAD = 1e-6


@dataclass(frozen=True)
class DetectionFrame:
    """Detections and objects of one frame."""

    name: str
    sequence: str
    """Frames of one sequence resemble each other."""
    detected: MultiBernoulli
    objects: LabelledBoxes
    lower: Float[ndarray, "D"]
    """Region of the states of objects that no detection explains."""
    upper: Float[ndarray, "D"]
    range_m: Float[ndarray, "N"] | None = None
    """Distance of each object over ground."""
    visibility: Float[ndarray, "N"] | None = None
    """Visibility of each object as the data set measures it: lidar points, or a level of occlusion."""
    relevance: Float[ndarray, "N"] | None = None
    """Weight of each object, where the truth has one."""
    stated: "StatedDetections | None" = None
    """Detections as the file states them. None: the likeliest class, and its probability."""
    object_counts: Bool[ndarray, "N"] | None = None
    """True if average precision counts the object. None: it counts all."""


@dataclass(frozen=True)
class StatedDetections:
    """Detections as average precision reads them from a file."""

    label: Int[ndarray, "M"]
    score: Float[ndarray, "M"]
    counts: Bool[ndarray, "M"]
    """True if average precision counts the detection."""


@dataclass(frozen=True)
class DetectionSet:
    """Frames of one file of detections. 3-D boxes have a heading and are in m, image boxes in pixels."""

    frames: Sequence[DetectionFrame]
    classes: Sequence[str]
    is_3d: bool
    counts: dict[str, int]
    """Number of assumed or missing values, by name."""
    true_classes: int
    """Number of classes of the truth, which come first; detections alone name the others."""


def make_detections(
    names: Sequence[str],
    score: Float[ndarray, "M"],
    class_probability: Float[ndarray, "M K"],
    mean: Float[ndarray, "M D"],
    covariance: Float[ndarray, "M D D"],
    yaw: Float[ndarray, "M"] | None = None,
    yaw_std: Float[ndarray, "M"] | None = None,
    *,
    family: Family = "gaussian",
) -> MultiBernoulli:
    """Check and convert the detections of one frame.

    Raises:
        InputError: a detection is wrong. The message begins with the name of the first.
    """
    # Checks name the first wrong record, so they come before any conversion
    chol, definite = _cholesky(covariance)
    checks = {
        "a score outside [0, 1]": (score >= 0) & (score <= 1),
        "class probabilities that do not add up to 1": (class_probability >= 0).all(1)
        & (np.abs(class_probability.sum(1) - 1) < 1e-3),
        "a box that is not finite": np.isfinite(mean).all(1),
        "a covariance that is not positive definite": definite,
    }
    if yaw is not None and yaw_std is not None:
        checks["a heading that is not finite"] = np.isfinite(yaw)
        fault = f"a standard deviation of its heading below {MIN_STD_YAW_RAD:g} rad"
        checks[fault] = yaw_std >= MIN_STD_YAW_RAD
    for fault, valid in checks.items():
        if not valid.all():
            raise InputError(f"{names[int(np.flatnonzero(~valid)[0])]} has {fault}")
    # Probabilities of 0 and 1 would give infinite likelihoods
    r = torch.as_tensor(np.clip(score, MIN_PROBABILITY, 1 - MIN_PROBABILITY))
    share = np.clip(class_probability, MIN_PROBABILITY, None)
    boxes = BoxDensity(
        mean=torch.as_tensor(mean),
        chol=torch.as_tensor(chol),
        yaw=None if yaw is None else torch.as_tensor(yaw),
        # A von Mises density with concentration 1/σ² is close to a normal one of σ
        concentration=None if yaw_std is None else torch.as_tensor(1.0 / yaw_std**2),
        family=family,
    )
    log_class = torch.as_tensor(np.log(share / share.sum(1, keepdims=True)))
    return MultiBernoulli(r.log(), torch.log1p(-r), log_class, boxes)


def make_objects(
    names: Sequence[str],
    label: Sequence[int],
    state: Float[ndarray, "N D"],
    yaw: Float[ndarray, "N"] | None = None,
) -> LabelledBoxes:
    """Check and convert the objects of one frame.

    Raises:
        InputError: a box is not finite. The message begins with the name of the first.
    """
    valid = np.isfinite(state).all(1) & (True if yaw is None else np.isfinite(yaw))
    if not valid.all():
        raise InputError(f"{names[int(np.flatnonzero(~valid)[0])]} has a box that is not finite")
    headings = None if yaw is None else torch.as_tensor(yaw)
    return LabelledBoxes(torch.as_tensor(np.asarray(label, dtype=np.int64)), torch.as_tensor(state), headings)


def _cholesky(
    covariance: Float[ndarray, "M D D"],
) -> tuple[Float[ndarray, "M D D"], Bool[ndarray, "M"]]:
    """Return the lower factors, and whether each covariance has one. The factors are zeros unless all do."""
    # The factor of all matrices at once; only after a failure are the wrong ones looked for
    finite = np.isfinite(covariance).all((1, 2))
    try:
        if finite.all():
            return np.linalg.cholesky(covariance), finite
    except np.linalg.LinAlgError:
        pass
    min_eigenvalue = np.zeros(len(covariance))
    min_eigenvalue[finite] = np.linalg.eigvalsh(covariance[finite]).min(-1)
    definite = min_eigenvalue > 0
    if definite.all():  # eigenvalues round otherwise than the factor, which failed
        definite[min_eigenvalue.argmin()] = False
    return np.zeros_like(covariance), definite


def read_covariances(
    records: Sequence[Mapping[str, Any]], default: Float[ndarray, "n D D"], names: Sequence[str]
) -> Float[ndarray, "n D D"]:
    """Return the covariances of records, given as matrices or variances, or else the default."""
    stated = [n for n, record in enumerate(records) if record.get("covariance") is not None]
    covariance = np.array(default)
    if stated:
        values = [records[n]["covariance"] for n in stated]
        dims = covariance.shape[-1]
        covariance[stated] = _covariance_matrices(values, dims, [names[n] for n in stated])
    return covariance


def _covariance_matrices(
    values: Sequence[object], dims: int, names: Sequence[str]
) -> Float[ndarray, "n D D"]:
    """Convert all covariances at once if they have the same form, else one by one, which is much slower."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        if len(values) == 1:
            raise InputError(f"{names[0]}: its covariance is not made of numbers") from error
        array = np.zeros(0)
    # Variances become diagonal matrices
    if array.shape == (len(values), dims):
        return array[:, :, None] * np.eye(dims)
    if array.shape == (len(values), dims, dims):
        # Symmetric up to rounding in the file
        slack = 1e-6 * np.abs(array).max((1, 2), keepdims=True)
        if not (np.abs(array - array.swapaxes(1, 2)) > slack).any():  # NaN passes: `make_detections` checks
            return array
    if len(values) == 1:
        raise InputError(
            f"{names[0]}: its covariance is neither {dims} variances nor a symmetric matrix of them"
        )
    # Forms differ between records: convert each one alone
    single = [_covariance_matrices([value], dims, names[n : n + 1]) for n, value in enumerate(values)]
    return np.concatenate(single)


def read_class_probabilities(
    records: Sequence[Mapping[str, Any]],
    labels: Sequence[int],
    classes: Sequence[str],
    names: Sequence[str],
) -> Float[ndarray, "n K"]:
    """Return the class probabilities of records. A record without them has its label with probability 1."""
    share, place = np.zeros((len(records), len(classes))), {name: n for n, name in enumerate(classes)}
    for n, (record, label) in enumerate(zip(records, labels, strict=True)):
        stated = record.get("class_probabilities")
        if stated is None:
            share[n, label] = 1.0
            continue
        if not isinstance(stated, dict) or not stated.keys() <= place.keys():
            raise InputError(
                f"{names[n]}: class_probabilities must be an object with known classes as its keys"
            )
        try:
            share[n, [place[name] for name in stated]] = np.array([*stated.values()], dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{names[n]}: class_probabilities must be numbers") from error
    return share


def order_classes(true: set[str], predicted: set[str]) -> tuple[list[str], int]:
    """Return the classes of the truth, then those of detections alone, and the number of the former.

    If the truth has no classes, those of the detections count as its own.
    """
    return sorted(true) + sorted(predicted - true), len(true) or len(predicted)


def enclosing_region(
    lower: Float[ndarray, "D"], upper: Float[ndarray, "D"], states: Float[ndarray, "N D"]
) -> tuple[Float[ndarray, "D"], Float[ndarray, "D"]]:
    """Return the region, enlarged so that it contains all states."""
    if len(states) == 0:
        return lower, upper
    return np.minimum(lower, states.min(0)), np.maximum(upper, states.max(0))


def read_relevance(objects: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Float[ndarray, "N"] | None:
    """Return the weights of objects: 1 where a record has none, None if no record has one."""
    if not any("relevance" in record for record in objects):
        return None
    weight = np.ones(len(objects))
    for n, record in enumerate(objects):
        if "relevance" in record:
            weight[n] = read_numbers(record, "relevance", 1, names[n])[0]
            if weight[n] < 0:
                raise InputError(f"{names[n]} has a relevance below 0")
    return weight
