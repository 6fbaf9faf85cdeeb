"""Random finite sets of labelled boxes: multi-Bernoulli, Poisson, and their union."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene.record import Record
from foredrive.sets.box_kernel import log_sum_exp
from foredrive.sets.boxes import BoxDensity, LabelledBoxes, require

_ROUNDING = 1e-4  # tolerance for probabilities computed in float32


@dataclass(frozen=True)
class MultiBernoulli(Record):
    """M objects that exist independently of each other (thesis eq. 3.9 and 3.10).

    Existence is stored as two logarithms, because 1 - r loses all digits where r is close to 1.

    Raises:
        InputError: a value is not the logarithm of a probability.
    """

    log_existence: Float[Tensor, "*b M"]
    """log r."""
    log_absence: Float[Tensor, "*b M"]
    """log(1 - r)."""
    log_class: Float[Tensor, "*b M K"]
    """Log-probability of each class, given that the object exists."""
    boxes: BoxDensity
    normalised: bool = True
    """True if class probabilities add up to 1. If they do not, likelihoods are not those of a density."""

    def __post_init__(self) -> None:
        require("existence", self.log_existence <= _ROUNDING)
        require("absence", self.log_absence <= _ROUNDING)
        total = torch.logaddexp(self.log_existence, self.log_absence)
        require("existence (which adds up to 1 with absence)", total.abs() <= _ROUNDING)
        if self.normalised:
            require("class distribution", self.log_class.logsumexp(-1).abs() <= _ROUNDING)

    @classmethod
    def from_softmax(cls, logits: Float[Tensor, "*b M K_1"], boxes: BoxDensity) -> "MultiBernoulli":
        """Convert the logits of a detector with one softmax over the classes and "no object" (DETR)."""
        # Softmax over K classes and "no object": existence is the sum over the classes
        log_prob = logits.double().log_softmax(-1)
        log_existence = log_prob[..., :-1].logsumexp(-1)
        return cls(log_existence, log_prob[..., -1], log_prob[..., :-1] - log_existence[..., None], boxes)

    @classmethod
    def from_sigmoid(
        cls,
        logits: Float[Tensor, "*b M K"],
        boxes: BoxDensity,
        classes: Literal["normalised", "published"] = "normalised",
    ) -> "MultiBernoulli":
        """Convert the logits of a detector with one sigmoid s_c per class (RetinaNet). r is the largest s_c.

        With `classes` "normalised", the class probabilities are proportional to the sigmoids. With
        "published", r · p(c) = s_c as in Paper A: the probabilities add up to more than 1.
        """
        top = logits.double().amax(-1)
        log_score = torch.nn.functional.logsigmoid(logits.double())
        log_existence = torch.nn.functional.logsigmoid(top)
        # Largest score as existence; the published variant keeps each class' own score
        normalised = classes == "normalised"
        log_total = log_score.logsumexp(-1) if normalised else log_existence
        log_absence = torch.nn.functional.logsigmoid(-top)
        return cls(log_existence, log_absence, log_score - log_total[..., None], boxes, normalised)

    def log_label(self, objects: LabelledBoxes) -> Float[Tensor, "*b M N"]:
        """Return the log-probability that each object exists with its label."""
        label = checked_labels(objects.label, self.log_class.shape[-1])
        # One row of labels for every component
        index = label[..., None, :].expand(*self.log_class.shape[:-1], label.shape[-1])
        return self.log_existence.double()[..., None] + self.log_class.double().gather(-1, index)

    def log_label_of_pairs(
        self, component: Int[Tensor, "E"], objects: LabelledBoxes, box: Int[Tensor, "E"]
    ) -> Float[Tensor, "E"]:
        """Return `log_label` at pairs of a component and an object of one frame."""
        log_class = self.log_class[component, objects.label.long()[box]]
        return self.log_existence[component].double() + log_class.double()

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set. The process must have one frame only.

        Raises:
            InputError: the class probabilities do not add up to 1.
        """
        if not self.normalised:
            raise InputError("class probabilities that do not add up to 1 cannot be drawn from")
        exists = torch.as_tensor(rng.random(len(self.log_existence)) < self.log_existence.exp().cpu().numpy())
        state, yaw = self.boxes.sample(rng)
        label = _sample_labels(self.log_class, rng)
        return LabelledBoxes(label, state, yaw)[exists]


@runtime_checkable
class PoissonProcess(Protocol):
    """Independent objects of unlimited number (thesis eq. 3.11)."""

    @property
    def expected_count(self) -> Float[Tensor, ""]:
        """Return ∫λ."""
        ...

    def log_intensity(self, objects: LabelledBoxes) -> Float[Tensor, "N"]:
        """Return log λ at each object, float64."""
        ...

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set."""
        ...


@dataclass(frozen=True)
class UniformPoisson(Record):
    """Objects uniformly distributed over a box of states and, with `has_yaw`, over all headings."""

    rate: Float[Tensor, "K"]
    """Expected number of objects of each class."""
    lower: Float[Tensor, "D"]
    upper: Float[Tensor, "D"]
    has_yaw: bool = False

    def __post_init__(self) -> None:
        if not bool((self.lower < self.upper).all()):
            raise InputError("the region of a uniform Poisson process is empty")
        if not bool((self.rate.isfinite() & (self.rate >= 0)).all()):
            raise InputError("rates of a uniform Poisson process must be finite and not negative")

    @property
    def expected_count(self) -> Float[Tensor, ""]:
        """Return ∫λ."""
        return self.rate.double().sum()

    def log_intensity(self, objects: LabelledBoxes) -> Float[Tensor, "N"]:
        """Return log λ at each object, float64. It is -inf outside the region."""
        label = checked_labels(objects.label, len(self.rate))
        log_volume = (self.upper - self.lower).double().log().sum()
        log_volume = log_volume + (math.log(2 * math.pi) if self.has_yaw else 0.0)
        inside = ((objects.state >= self.lower) & (objects.state <= self.upper)).all(-1)
        return torch.where(inside, self.rate.double().log()[label] - log_volume, -math.inf)

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set."""
        # Number of objects by class, then their states
        counts = rng.poisson(self.rate.cpu().numpy())
        label = torch.as_tensor(np.repeat(np.arange(len(counts)), counts))
        unit = torch.as_tensor(rng.random((len(label), len(self.lower))))
        lower, upper = self.lower.double().cpu(), self.upper.double().cpu()
        yaw = torch.as_tensor(rng.uniform(-math.pi, math.pi, len(label))) if self.has_yaw else None
        return LabelledBoxes(label, lower + unit * (upper - lower), yaw)


@dataclass(frozen=True)
class MixturePoisson(Record):
    """Objects around M places: λ(y) = Σ_i rate_i p_i(y)."""

    log_rate: Float[Tensor, "M"]
    """Logarithm of the expected number of objects of each component."""
    log_class: Float[Tensor, "M K"]
    boxes: BoxDensity

    @property
    def expected_count(self) -> Float[Tensor, ""]:
        """Return ∫λ."""
        return self.log_rate.double().exp().sum()

    def log_intensity(self, objects: LabelledBoxes) -> Float[Tensor, "N"]:
        """Return log λ at each object, float64."""
        label = checked_labels(objects.label, self.log_class.shape[-1])
        log_class = self.log_class.double()[:, label]
        log_each = self.log_rate.double()[:, None] + log_class + self.boxes.log_prob(objects)
        if log_each.requires_grad or log_each.device.type != "cpu":
            return log_each.logsumexp(0)
        return torch.as_tensor(log_sum_exp(log_each.numpy()))

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set."""
        counts = torch.as_tensor(rng.poisson(self.log_rate.double().exp().cpu().numpy()))
        which = torch.arange(len(counts)).repeat_interleave(counts)
        state, yaw = self.boxes[which].sample(rng)
        return LabelledBoxes(_sample_labels(self.log_class[which], rng), state, yaw)


@dataclass(frozen=True)
class SumPoisson:
    """The union of independent Poisson processes. It is a Poisson process with the sum of the intensities."""

    parts: tuple[PoissonProcess, ...]

    @property
    def expected_count(self) -> Float[Tensor, ""]:
        """Return ∫λ."""
        return torch.stack([part.expected_count for part in self.parts]).sum()

    def log_intensity(self, objects: LabelledBoxes) -> Float[Tensor, "N"]:
        """Return log λ at each object, float64."""
        return torch.stack([part.log_intensity(objects) for part in self.parts]).logsumexp(0)

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set."""
        return _joined([part.sample(rng) for part in self.parts])


@dataclass(frozen=True)
class PoissonMultiBernoulli:
    """The union of a multi-Bernoulli and a Poisson process (thesis eq. 3.12), or a multi-Bernoulli alone."""

    detected: MultiBernoulli
    background: PoissonProcess | None = None

    @classmethod
    def from_detections(
        cls, detections: MultiBernoulli, confidence: float = 0.1, other: PoissonProcess | None = None
    ) -> "PoissonMultiBernoulli":
        """Convert the detections of one frame into a PMB density (Paper A).

        Detections with r ≤ `confidence` become the Poisson process, always with normalised classes. The
        process `other`, such as a uniform one, is added to it. Without it, objects far from every detection
        have almost zero density.
        """
        # Unsure detections become the intensity of the background
        low = detections.log_existence <= math.log(confidence)
        unsure = detections[low]
        log_class = unsure.log_class if unsure.normalised else unsure.log_class.log_softmax(-1)
        mixture = MixturePoisson(unsure.log_existence, log_class, unsure.boxes)
        return cls(detections[~low], mixture if other is None else SumPoisson((mixture, other)))

    def sample(self, rng: np.random.Generator) -> LabelledBoxes:
        """Draw one set."""
        samples = self.detected.sample(rng)
        if self.background is None:
            return samples
        return _joined([samples, self.background.sample(rng)])


def poisson_log_prob(process: PoissonProcess, objects: LabelledBoxes) -> Float[Tensor, ""]:
    """Return the log-density of a set of objects under a Poisson process (thesis eq. 3.11)."""
    return process.log_intensity(objects).sum() - process.expected_count


def _joined(sets: Sequence[LabelledBoxes]) -> LabelledBoxes:
    label, state = torch.cat([one.label for one in sets]), torch.cat([one.state for one in sets])
    headings = [one.yaw for one in sets if one.yaw is not None]
    return LabelledBoxes(label, state, torch.cat(headings) if len(headings) == len(sets) else None)


def checked_labels(label: Int[Tensor, "..."], classes: int) -> Int[Tensor, "..."]:
    """Return labels as indices.

    Raises:
        InputError: a label is out of range. The message names the first.
    """
    wrong = ((label < 0) | (label >= classes)).nonzero()
    if len(wrong):
        place = tuple(wrong[0].tolist())
        raise InputError(f"object {place} has label {int(label[place])}, of {classes} classes")
    return label.long()


def _sample_labels(log_class: Float[Tensor, "M K"], rng: np.random.Generator) -> Tensor:
    # Inverse transform sampling of the class
    cumulative = log_class.double().exp().cpu().cumsum(-1)
    draw = torch.as_tensor(rng.random(len(cumulative)))[:, None] * cumulative[:, -1:]
    return (draw >= cumulative).sum(-1).clamp_max(log_class.shape[-1] - 1)
