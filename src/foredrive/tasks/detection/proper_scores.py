"""Proper scores of single predictions: numbers, boxes, events. Lower is better."""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.special import ndtr

from foredrive.sets.boxes import BoxDensity, LabelledBoxes


def brier(probability: Float[ndarray, "n"], happened: Bool[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Return the squared error of probabilities (Brier 1950)."""
    return (probability - happened) ** 2


def object_brier(
    probability: Float[ndarray, "M K"], near: Bool[ndarray, "M N"], label: Int[ndarray, "N"]
) -> Float[ndarray, "N"]:
    """Return the squared error of the mean class probabilities of detections near each object; 1 without any.

    `probability` is that of existence with each class. The mean over objects is the object-level calibration
    error of Park, Sobolewski and Azizan (arXiv 2412.01782), at one threshold of nearness.
    """
    count = near.sum(0)
    # Mean class probabilities over the detections near each object
    mean = near.T.astype(float) @ probability / np.maximum(count, 1)[:, None]
    # Minus the one-hot truth; the squared sum is the Brier score
    mean[np.arange(len(label)), label] -= 1.0
    return np.where(count > 0, (mean**2).sum(1), 1.0)


def crps_gaussian(
    mean: Float[ndarray, "..."], std: Float[ndarray, "..."], value: Float[ndarray, "..."]
) -> Float[ndarray, "..."]:
    """Return the continuous ranked probability score of normal predictions, in the unit of the value.

    Gneiting and Raftery (2007), eq. 21.
    """
    # Closed form for a normal distribution
    z = (value - mean) / std
    density = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    return std * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi))


def crps_laplace(
    mean: Float[ndarray, "..."], std: Float[ndarray, "..."], value: Float[ndarray, "..."]
) -> Float[ndarray, "..."]:
    # Closed form for a Laplace distribution
    """Return that of Laplace predictions, which have scale σ/√2."""
    scale = std / math.sqrt(2)
    z = np.abs(value - mean) / scale
    return scale * (z + np.exp(-z) - 0.75)


def energy_score(
    boxes: BoxDensity, objects: LabelledBoxes, rng: np.random.Generator, samples: int = 256
) -> Float[ndarray, "n"]:
    """Estimate the energy score of the state of box i under density i (Gneiting and Raftery 2007, eq. 22).

    E|X - y| - ½ E|X - X'| over `samples` draws of either; unbiased. Headings are left out.
    """
    # Two independent sets of draws of every box
    repeated = boxes[np.repeat(np.arange(len(boxes.mean)), 2 * samples)]
    shape = (len(boxes.mean), 2, samples, boxes.mean.shape[-1])
    one, other = np.moveaxis(repeated.sample(rng)[0].numpy().reshape(shape), 1, 0)
    truth = objects.state.double().cpu().numpy()[:, None]
    # Both sets estimate E|X - y|, pairs of them E|X - X'|
    to_truth = 0.5 * (np.linalg.norm(one - truth, axis=-1) + np.linalg.norm(other - truth, axis=-1))
    return (to_truth - 0.5 * np.linalg.norm(one - other, axis=-1)).mean(-1)
