"""The package's detections and boxes as random finite sets."""

import math

import pytest
import torch

from foredrive.errors import InputError
from foredrive.scene import Boxes, Detections
from foredrive.scene.boxes import unlabelled
from foredrive.sets import LabelledBoxes, UniformPoisson, set_nll
from foredrive.sets.detections import objects_from_boxes, pmb_from_detections


def detections(**changes: torch.Tensor | None) -> Detections:
    """Two detections, the second of which is padding."""
    mean = torch.tensor([[1.0, 2.0, 0.5, 1.4, 0.6, 0.4, 0.6, 0.8], [float("nan")] * 8])
    fields: dict[str, torch.Tensor | None] = {
        "existence": torch.tensor([0.8, float("nan")]),
        "log_class": torch.tensor([[0.9, 0.1], [0.5, 0.5]]).log(),
        "mean": mean,
        "chol": torch.diag_embed(torch.tensor([[0.5, 0.5, 0.2, 0.1, 0.1, 0.1, 0.03, 0.04]] * 2)),
        "valid": torch.tensor([True, False]),
        "background_rate": torch.tensor([2.0, 1.0]),
    }
    return Detections(**(fields | changes))  # type: ignore[arg-type]


def test_the_heading_by_hand() -> None:
    """(sin, cos) = (.6, .8) with σ .03 and .04: var θ = (.8·.03)² + (.6·.04)² on the unit circle."""
    boxes = pmb_from_detections(detections(background_rate=None)).detected.boxes
    assert boxes.yaw is not None
    assert boxes.concentration is not None
    assert boxes.yaw.item() == pytest.approx(math.atan2(0.6, 0.8))
    assert boxes.concentration.item() == pytest.approx(1 / (0.024**2 + 0.024**2), rel=1e-5)


def test_a_longer_arrow_has_a_surer_heading() -> None:
    mean = detections().mean.clone()
    mean[0, 6:] *= 2
    short = pmb_from_detections(detections(background_rate=None)).detected.boxes.concentration
    long = pmb_from_detections(detections(background_rate=None, mean=mean)).detected.boxes.concentration
    assert short is not None
    assert long is not None
    assert (long / short).item() == pytest.approx(4.0)


def test_the_marginal_covariance_is_kept() -> None:
    root = torch.randn(1, 8, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    chol = torch.linalg.cholesky(root @ root.mT + torch.eye(8)).repeat(2, 1, 1)
    boxes = pmb_from_detections(detections(chol=chol, background_rate=None)).detected.boxes
    torch.testing.assert_close(boxes.chol @ boxes.chol.mT, (chol[:1] @ chol[:1].mT)[:, :6, :6])


def test_the_background_fills_its_region() -> None:
    lower, upper = torch.tensor([-50.0, -50, -5, -3, -3, -3]), torch.tensor([50.0, 50, 5, 4, 3, 3])
    pmb = pmb_from_detections(detections(), lower, upper)
    assert isinstance(pmb.background, UniformPoisson)
    at = LabelledBoxes(torch.tensor([1]), torch.zeros(1, 6), torch.zeros(1))
    log_volume = math.log(100 * 100 * 10 * 7 * 6 * 6 * 2 * math.pi)
    assert pmb.background.log_intensity(at).item() == pytest.approx(-log_volume, abs=1e-5)
    with pytest.raises(InputError, match="region"):
        pmb_from_detections(detections())


def test_from_boxes_to_a_likelihood() -> None:
    boxes = Boxes(
        centre=torch.tensor([[1.0, 2.0, 0.5], [9.0, 9.0, 9.0]]),
        size_lwh=torch.tensor([[math.exp(1.4), math.exp(0.6), math.exp(0.4)], [0.0, 0.0, 0.0]]),
        yaw=torch.tensor([math.atan2(0.6, 0.8), 0.0]),
        velocity=torch.zeros(2, 2),
        track_id=torch.arange(2),
        category=torch.tensor([0, 1]),
        valid=torch.tensor([True, False]),
        **unlabelled(2),
    )
    pmb = pmb_from_detections(detections(background_rate=None))
    linear = -sum(math.log(s * math.sqrt(2 * math.pi)) for s in (0.5, 0.5, 0.2, 0.1, 0.1, 0.1))
    kappa = 1 / (2 * 0.024**2)
    heading = 0.5 * math.log(kappa / (2 * math.pi))  # where κ is large
    score = set_nll(pmb, objects_from_boxes(boxes))
    assert score.nll.item() == pytest.approx(-(linear + heading + math.log(0.8 * 0.9)), abs=1e-3)
    wrong = Boxes(**{**vars(boxes), "valid": torch.ones(2, dtype=torch.bool)})
    with pytest.raises(InputError, match=r"size of box \(1,\)"):
        objects_from_boxes(wrong)


def test_bad_detections_are_named() -> None:
    with pytest.raises(InputError, match=r"existence of detection \(0,\)"):
        pmb_from_detections(detections(existence=torch.tensor([1.2, 0.0])))
    with pytest.raises(InputError, match=r"covariance"):
        pmb_from_detections(detections(chol=torch.zeros(2, 8, 8)))
