"""Occupancy counts, the best constant, flow errors."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.scene import VoxelGrid, VoxelSpec
from foredrive.tasks.occupancy.scores import OccupancyPrior, above_ground, count_occupancy, flow_errors

SPEC = VoxelSpec(lower_m=(-1.0, -1.0, -0.5), voxel_m=0.5, shape_zyx=(3, 4, 4))


def labels(occupied: torch.Tensor, known: torch.Tensor) -> VoxelGrid:
    """Labels from [b F Z Y X] tensors."""
    return VoxelGrid(SPEC, occupied.float()[:, :, None], known)


def random_labels(seed: int, batch: int = 2, frames: int = 2, share: float = 0.3) -> VoxelGrid:
    generator = torch.Generator().manual_seed(seed)
    shape = (batch, frames, *SPEC.shape_zyx)
    return labels(
        torch.rand(shape, generator=generator) < share, torch.rand(shape, generator=generator) < 0.8
    )


def test_counts_by_hand() -> None:
    occupied = torch.zeros(1, 1, 3, 4, 4, dtype=torch.bool)
    known = torch.ones_like(occupied)
    occupied[0, 0, 0, 0, :4] = True  # four on the ground,
    occupied[0, 0, 2, 0, :2] = True  # two above it
    known[0, 0, 0, 0, 3] = False  # one of the four is unknown after all
    predicted = torch.zeros_like(occupied)
    predicted[0, 0, 0, 0, 1:] = True  # right twice (the third is unknown)
    predicted[0, 0, 2, 0, 1:3] = True  # right once, wrong once
    counts = count_occupancy(predicted, labels(occupied, known))
    assert (counts.true_positive.item(), counts.false_positive.item(), counts.false_negative.item()) == (
        3,
        1,
        2,
    )
    assert counts.iou.item() == pytest.approx(3 / 6)
    assert counts.precision.item() == pytest.approx(3 / 4)
    assert counts.recall.item() == pytest.approx(3 / 5)
    # Voxel centres lie at z = -0.25, 0.25 and 0.75 m: the top layer alone is above 0.4 m.
    above = count_occupancy(predicted, labels(occupied, known), above_ground(SPEC))
    assert above.iou.item() == pytest.approx(1 / 3)


def test_ratios_are_taken_once_over_the_data_set() -> None:
    occupied = torch.zeros(2, 1, 3, 4, 4, dtype=torch.bool)
    occupied[0, 0, 0, 0, :4] = True
    occupied[1, 0, 0, 0, 0] = True
    predicted = torch.zeros_like(occupied)
    predicted[0, 0, 0, 0, :4] = True  # IoU 4 / 4
    predicted[1, 0, 0, 1, 0] = True  # IoU 0 / 2
    known = torch.ones_like(occupied)
    first, second = (
        count_occupancy(predicted[i : i + 1], labels(occupied, known)[i : i + 1]) for i in range(2)
    )
    together = count_occupancy(predicted, labels(occupied, known))
    assert (first + second).iou.item() == together.iou.item() == pytest.approx(4 / 6)


def test_nothing_to_find_and_nothing_found_is_no_number() -> None:
    empty = torch.zeros(1, 1, 3, 4, 4, dtype=torch.bool)
    counts = count_occupancy(empty, labels(empty, ~empty))
    assert all(math.isnan(v.item()) for v in (counts.iou, counts.precision, counts.recall))


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.integers(0, 10_000))
def test_iou_is_bounded_symmetric_and_one_only_for_itself(a: int, b: int) -> None:
    one, other = random_labels(a), random_labels(b)
    known = one.known & other.known
    one, other = VoxelGrid(SPEC, one.values, known), VoxelGrid(SPEC, other.values, known)
    forth = count_occupancy(one.values[:, :, 0] > 0, other)
    back = count_occupancy(other.values[:, :, 0] > 0, one)
    assert torch.equal(forth.iou, back.iou)
    assert torch.equal(forth.precision, back.recall)
    assert bool(((forth.iou >= 0) & (forth.iou <= torch.minimum(forth.precision, forth.recall))).all())
    assert bool((count_occupancy(one.values[:, :, 0] > 0, one).iou == 1).all())


def test_the_prior_by_hand() -> None:
    occupied = torch.zeros(4, 1, 3, 4, 4, dtype=torch.bool)
    occupied[:, 0, 0, 0, 0] = True  # always
    occupied[:2, 0, 0, 0, 1] = True  # half of the time
    occupied[:1, 0, 0, 0, 2] = True  # a quarter
    prior = OccupancyPrior(1, SPEC)
    prior.add(labels(occupied[:3], torch.ones_like(occupied[:3])))
    prior.add(labels(occupied[3:], torch.ones_like(occupied[3:])))
    torch.testing.assert_close(prior.probability[0, 0, 0], torch.tensor([1.0, 0.5, 0.25, 0.0]))
    # Of seven occupied voxels: {1} has IoU 4 / 7, {1, ½} 6 / 9, {1, ½, ¼} 7 / 12.
    predicted, threshold = prior.best_grid()
    assert threshold.tolist() == [0.5]
    assert predicted.nonzero().tolist() == [[0, 0, 0, 0], [0, 0, 0, 1]]


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.floats(0.02, 0.6), st.booleans())
def test_no_threshold_beats_the_best_grid_on_its_own_training_set(
    seed: int, share: float, above: bool
) -> None:
    training = random_labels(seed, batch=5, share=share)
    region = above_ground(SPEC) if above else None
    prior = OccupancyPrior(2, SPEC)
    prior.add(training)
    predicted, _ = prior.best_grid(region)
    best = count_occupancy(predicted.expand(5, -1, -1, -1, -1), training, region).iou.nan_to_num(0.0)
    for threshold in torch.cat([prior.probability.unique(), torch.tensor([0.0, 0.123])]):
        rival = (prior.probability >= threshold).expand(5, -1, -1, -1, -1)
        other = count_occupancy(rival, training, region).iou.nan_to_num(0.0)
        assert bool((best >= other - 1e-6).all())


def test_a_voxel_never_known_is_never_predicted() -> None:
    occupied = torch.ones(1, 1, 3, 4, 4, dtype=torch.bool)
    known = torch.zeros_like(occupied)
    known[0, 0, 0] = True
    prior = OccupancyPrior(1, SPEC)
    prior.add(labels(occupied, known))
    predicted, _ = prior.best_grid()
    assert torch.equal(predicted, known[0])


def test_a_training_set_without_anything_predicts_nothing() -> None:
    prior = OccupancyPrior(2, SPEC)
    prior.add(random_labels(0, share=0.0))
    predicted, threshold = prior.best_grid()
    assert not predicted.any()
    assert torch.isinf(threshold).all()


def test_labels_on_another_grid_are_refused() -> None:
    with pytest.raises(InputError, match="do not fit"):
        OccupancyPrior(3, SPEC).add(random_labels(0, frames=2))


def test_flow_errors_by_hand() -> None:
    truth = torch.zeros(1, 1, 3, 3, 4, 4)
    truth[0, 0, 0, 0, 0, 0] = 3.0  # moves at 3 m/s along x
    truth[0, 0, 1, 0, 0, 1] = 4.0  # at 4 m/s along y, but nobody knows
    truth[0, 0, 0, 0, 0, 2] = 0.2  # hardly moves
    known = torch.ones(1, 1, 3, 4, 4, dtype=torch.bool)
    known[0, 0, 0, 0, 1] = False
    predicted = torch.zeros_like(truth)
    predicted[0, 0, 1, 0, 0, 0] = 4.0  # 4 m/s along y instead: 5 m/s off
    errors = flow_errors(predicted, VoxelGrid(SPEC, truth, known))
    assert (errors.error_mps.item(), errors.speed_mps.item(), errors.voxels.item()) == (5.0, 3.0, 1)
    twice = errors + errors
    assert (twice.error_mps.item(), twice.voxels.item()) == (10.0, 2)
