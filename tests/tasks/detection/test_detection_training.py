"""A detection head and its losses: by hand, against closed forms, and in training."""

import functools
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from foredrive.errors import InputError
from foredrive.heads.detection_losses import MatchingLossConfig, energy_score, matching_loss, set_loss
from foredrive.heads.detection_network import BoxSet, DetectionHead
from foredrive.heads.detection_training import fit_head
from foredrive.scene import VoxelSpec
from foredrive.sets import Family, LabelledBoxes, PoissonMultiBernoulli, pmb_from_detections, set_nll
from foredrive.tasks.detection.proper_scores import crps_gaussian, crps_laplace


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Threads would wait for each other longer than they work."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


SPEC = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=1.0, shape_zyx=(2, 16, 16))


def head() -> DetectionHead:
    torch.manual_seed(0)
    return DetectionHead(SPEC, channels=1, classes=2, width=16, shrink=1, layers=1, heads=2)


def scenes(count: int) -> tuple[torch.Tensor, list[LabelledBoxes]]:
    """Volumes with one or two bright columns, each of them an object that heads along x."""
    generator = torch.Generator().manual_seed(1)
    volume, truth = torch.zeros(count, 1, 2, 16, 16), []
    for n in range(count):
        cells = torch.randperm(16 * 16, generator=generator)[: 1 + n % 2]
        y, x = cells // 16, cells % 16
        volume[n, 0, :, y, x] = 1.0
        size = torch.tensor([1.2, 0.4, 0.4]).expand(len(cells), 3)
        centre = torch.stack([x - 7.5, y - 7.5, torch.zeros(len(cells))], dim=-1)
        label, yaw = torch.zeros(len(cells), dtype=torch.long), torch.zeros(len(cells))
        truth.append(LabelledBoxes(label, torch.cat([centre, size], dim=-1), yaw))
    return volume, truth


def test_queries_stand_where_their_cells_are() -> None:
    """8 x 8 cells of 2 m; the first in the corner of least x and y, x running faster."""
    middle = head().middle_m
    assert middle.shape == (64, 2)
    assert middle[[0, 1, 8, 63]].tolist() == [[-7, -7], [-5, -7], [-7, -5], [7, 7]]


def test_detections_and_logits_say_the_same() -> None:
    """The likelihood is that of the package's own type, whichever way it is taken."""
    volume, truth = scenes(1)
    with torch.no_grad():
        found = head()(volume)[0]
        by_logits = set_nll(PoissonMultiBernoulli(found.as_multi_bernoulli()), truth[0]).nll
        by_type = set_nll(pmb_from_detections(found.detections()), truth[0]).nll
    assert by_type.item() == pytest.approx(by_logits.item(), rel=1e-5)


def test_matching_takes_each_object_to_the_query_that_fits() -> None:
    """The third query is the object's; better boxes, classes and spreads lower the loss, others' do not."""
    mean = torch.zeros(4, 6)
    mean[:, 0] = torch.tensor([-6.0, -2.0, 2.0, 6.0])
    heading = torch.tensor([0.0, 1.0]).expand(4, 2)
    logits = torch.zeros(4, 3)
    truth = LabelledBoxes(torch.tensor([1]), torch.tensor([[2.5, 0, 0, 0, 0, 0]]), torch.zeros(1))
    leaf = mean.clone().requires_grad_()
    leaf_logits = logits.clone().requires_grad_()
    found = BoxSet(leaf_logits, leaf, torch.zeros(4, 6), heading, torch.zeros(4))
    by_mean, by_logits = torch.autograd.grad(matching_loss(found, truth), (leaf, leaf_logits))
    assert by_mean.abs().sum(-1).nonzero().tolist() == [[2]]
    assert by_mean[2, 0] < 0  # towards larger x
    assert by_logits[2, 1] < 0
    assert by_logits[2, 2] > 0
    assert (by_logits[[0, 1, 3], 2] < 0).all()


energy_loss = functools.partial(
    matching_loss, config=MatchingLossConfig(box_score="energy", energy_samples=100)
)


@pytest.mark.parametrize(
    ("loss", "family"),
    [
        (matching_loss, "gaussian"),
        (energy_loss, "gaussian"),
        (set_loss, "laplace"),
    ],
)
def test_all_losses_teach_where_objects_are(
    loss: Callable[[BoxSet, LabelledBoxes], torch.Tensor], family: Family
) -> None:
    volume, truth = scenes(4)
    samples = list(zip(volume, truth, strict=True))
    untrained = head()
    untrained.family = family
    model = fit_head(untrained, samples, loss, steps=150, batch=4, learning_rate=5e-3)
    with torch.no_grad():
        found = model(volume)
    for n, objects in enumerate(truth):
        detected = found[n].as_multi_bernoulli()
        existence = detected.log_existence.exp()
        sure = existence > 0.5
        assert int(sure.sum()) == len(objects.label)
        apart = (detected.boxes.mean[sure][:, None, :2] - objects.state[:, :2]).norm(dim=-1)
        assert (apart.amin(0) < 0.7).all()


def test_empty_frames_teach_silence() -> None:
    volume, truth = scenes(1)
    found = head()(volume)[0]
    nothing = truth[0][:0]
    existence = found.as_multi_bernoulli().log_existence.exp()
    assert set_loss(found, nothing).item() == pytest.approx(-torch.log1p(-existence).sum().item(), rel=1e-6)
    assert torch.isfinite(matching_loss(found, nothing))


def one_box(family: Family, log_std: torch.Tensor) -> tuple[BoxSet, LabelledBoxes]:
    """A query of unknown class, 0.5 m from its object in x, that heads like the object."""
    heading = torch.tensor([[0.0, 1.0]])
    found = BoxSet(torch.zeros(1, 2), torch.zeros(1, 6), log_std, heading, torch.zeros(1), family)
    state = torch.tensor([[0.5, 0, 0, 0, 0, 0]])
    return found, LabelledBoxes(torch.tensor([0]), state, torch.zeros(1))


@pytest.mark.parametrize(
    ("family", "nll", "slope"),
    [
        # 0.5 z² + log σ at σ = 1/2: z = 1.  d/d log σ = 1 - z²
        ("gaussian", 0.5 + 6 * math.log(0.5), 0.0),
        # √2 |z| + log σ: Laplace of scale σ/√2.  d/d log σ = 1 - √2 |z|
        ("laplace", math.sqrt(2) + 6 * math.log(0.5), 1 - math.sqrt(2)),
    ],
)
def test_matching_by_hand(family: Family, nll: float, slope: float) -> None:
    log_std = torch.full((1, 6), math.log(0.5)).requires_grad_()
    found, truth = one_box(family, log_std)
    loss = matching_loss(found, truth)
    assert loss.item() == pytest.approx(math.log(2) + 0.5 * 0.5 + 0.1 * nll, abs=1e-6)
    (gradient,) = torch.autograd.grad(loss, log_std)
    assert gradient[0].tolist() == pytest.approx([0.1 * slope, *[0.1] * 5], abs=1e-6)


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_set_likelihood_by_hand(family: Family) -> None:
    """One query, so its only object is its own: p(object of the class) is a half."""
    found, truth = one_box(family, torch.full((1, 6), math.log(0.5)))
    z = torch.tensor([1.0, 0, 0, 0, 0, 0])
    if family == "gaussian":
        box = (0.5 * z**2 + 0.5 * math.log(2 * math.pi) + math.log(0.5)).sum().item()
    else:
        box = (math.sqrt(2) * z + math.log(2 * 0.5 / math.sqrt(2))).sum().item()
    heading = math.log(2 * math.pi) + math.log(float(torch.special.i0(torch.tensor(1.0)))) - 1.0
    assert set_loss(found, truth).item() == pytest.approx(math.log(2) + box + heading, abs=1e-5)


@pytest.mark.parametrize(("family", "crps"), [("gaussian", crps_gaussian), ("laplace", crps_laplace)])
def test_the_energy_score_in_one_dimension_is_the_crps(
    family: Family, crps: Callable[..., np.ndarray]
) -> None:
    """Value and gradients of mean and σ; those of the closed form are central differences."""
    torch.manual_seed(0)
    mean, std = (torch.full((1, 1), v, dtype=torch.float64).requires_grad_() for v in (0.2, 0.7))
    score = energy_score(mean, std, torch.ones(1, 1, dtype=torch.float64), family, 400_000)
    step = 1e-3 * np.array([0, 1, -1, 0, 0])
    expected = crps(0.2 + step, 0.7 + step[[0, 3, 4, 1, 2]], np.ones(5))
    assert score.item() == pytest.approx(expected[0], abs=0.005)
    by_mean, by_std = torch.autograd.grad(score.sum(), (mean, std))
    assert by_mean.item() == pytest.approx((expected[1] - expected[2]) / 2e-3, abs=0.01)
    assert by_std.item() == pytest.approx((expected[3] - expected[4]) / 2e-3, abs=0.01)


def test_the_energy_score_is_smallest_for_the_true_spread() -> None:
    """Objects spread with σ = 0.5 in three dimensions: half and twice the σ score worse on average."""
    torch.manual_seed(0)
    mean, state = torch.zeros(20_000, 3), 0.5 * torch.randn(20_000, 3)
    score = {
        std: energy_score(mean, torch.full_like(mean, std), state, "gaussian", 20).mean().item()
        for std in (0.25, 0.5, 1.0)
    }
    assert min(score, key=score.__getitem__) == 0.5


def test_more_objects_than_queries_are_an_error() -> None:
    """64 queries and 65 objects in the second sample, which have no likelihood without a background."""
    volume, truth = scenes(2)
    crowd = LabelledBoxes(
        *(torch.cat([part] * 65) for part in (truth[0].label, truth[0].state)), torch.zeros(65)
    )
    samples = [(volume[0], truth[0]), (volume[1], crowd)]
    with pytest.raises(InputError, match=r"sample 1 of 65 objects has the loss inf with 64 queries; without"):
        fit_head(head(), samples, set_loss, steps=1, batch=2)
    fit_head(head(), samples, matching_loss, steps=1, batch=2)  # 64 of them are matched


def test_batches_follow_from_the_seed() -> None:
    volume, truth = scenes(6)
    samples, untrained = list(zip(volume, truth, strict=True)), head()
    one, other = (fit_head(untrained, samples, matching_loss, steps=1, batch=2, seed=n) for n in (1, 2))
    assert not torch.equal(one.out[1].weight, other.out[1].weight)
