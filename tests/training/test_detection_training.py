"""A detection head and its two losses: one word for what it says, and both teach it."""

from collections.abc import Callable, Iterator

import pytest
import torch

from foredrive.models.detection import BoxSet, DetectionHead
from foredrive.scene import VoxelSpec
from foredrive.sets import LabelledBoxes, PoissonMultiBernoulli, pmb_from_detections, set_nll
from foredrive.training.detection import as_multi_bernoulli, fit_head, matching_loss, set_loss


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
        by_logits = set_nll(PoissonMultiBernoulli(as_multi_bernoulli(found)), truth[0]).nll
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
    said = logits.clone().requires_grad_()
    found = BoxSet(said, leaf, torch.zeros(4, 6), heading, torch.zeros(4))
    by_mean, by_logits = torch.autograd.grad(matching_loss(found, truth), (leaf, said))
    assert by_mean.abs().sum(-1).nonzero().tolist() == [[2]]
    assert by_mean[2, 0] < 0  # towards larger x
    assert by_logits[2, 1] < 0
    assert by_logits[2, 2] > 0
    assert (by_logits[[0, 1, 3], 2] < 0).all()


@pytest.mark.parametrize("loss", [matching_loss, set_loss])
def test_both_losses_teach_where_objects_are(loss: Callable[[BoxSet, LabelledBoxes], torch.Tensor]) -> None:
    volume, truth = scenes(4)
    samples = list(zip(volume, truth, strict=True))
    model = fit_head(head(), samples, loss, steps=150, batch=4, learning_rate=5e-3)
    with torch.no_grad():
        found = model(volume)
    for n, objects in enumerate(truth):
        detected = as_multi_bernoulli(found[n])
        existence = detected.log_existence.exp()
        sure = existence > 0.5
        assert int(sure.sum()) == len(objects.label)
        apart = (detected.boxes.mean[sure][:, None, :2] - objects.state[:, :2]).norm(dim=-1)
        assert (apart.amin(0) < 0.7).all()


def test_empty_frames_teach_silence() -> None:
    volume, truth = scenes(1)
    found = head()(volume)[0]
    nothing = truth[0][:0]
    existence = as_multi_bernoulli(found).log_existence.exp()
    assert set_loss(found, nothing).item() == pytest.approx(-torch.log1p(-existence).sum().item(), rel=1e-6)
    assert torch.isfinite(matching_loss(found, nothing))
