"""IoU and VPQ of instances over time: by hand, beside torchmetrics and a literal count."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics.detection import PanopticQuality

from foredrive.errors import InputError
from foredrive.scene.map_elements import InstanceRaster, PlaneSpec
from foredrive.tasks.occupancy.instances_metric import InstanceCounts, count_instances, count_rasters
from foredrive.tasks.occupancy.protocols import UNIAD_INSTANCES, InstanceProtocol

UNIAD = UNIAD_INSTANCES


def empty() -> np.ndarray:
    return np.zeros((5, 200, 200), np.int64)


def test_a_changed_number_is_false_and_missed_once_and_then_adopted() -> None:
    """One car, seen perfectly; its predicted number changes after two frames and stays."""
    true, predicted = empty(), empty()
    true[:, 100:109, 100:104] = 7
    predicted[:2, 100:109, 100:104] = 1
    predicted[2:, 100:109, 100:104] = 2
    near = count_instances(predicted, true, UNIAD)["near"]
    assert (near.pairs, near.false, near.missed) == (4, 1, 1)
    assert near.vpq == pytest.approx(4 / 5)
    assert near.iou == 1.0
    predicted[2, 100:109, 100:104] = 0  # a gap does not clear the memory: the new number is still new
    gap = count_instances(predicted, true, UNIAD)["near"]
    assert (gap.pairs, gap.false, gap.missed) == (3, 1, 2)


def test_half_of_the_union_is_no_match() -> None:
    true, predicted = empty(), empty()
    true[0, 100:102, 100:104] = 1  # 8 cells
    predicted[0, 100:102, 100:102] = 1  # 4 of them: IoU is exactly 0.5
    near = count_instances(predicted, true, UNIAD)["near"]
    assert (near.pairs, near.false, near.missed, near.vpq) == (0, 1, 1, 0.0)
    predicted[0, 100, 102] = 1  # 5 of 8
    near = count_instances(predicted, true, UNIAD)["near"]
    assert (near.pairs, near.iou_sum, near.vpq) == (1, 5 / 8, 5 / 8)
    assert near.iou == 5 / 8


def test_the_near_range_cuts_an_instance_before_it_is_compared() -> None:
    """A lorry of 20 rows, two of them in the near range; the prediction has these two, and two more."""
    true, predicted = empty(), empty()
    true[0, 52:72, 100:104] = 1  # rows 70 and 71 are near
    predicted[0, 68:72, 100:104] = 1
    counts = count_instances(predicted, true, UNIAD)
    assert (counts["near"].pairs, counts["near"].iou_sum) == (1, 1.0)
    assert counts["near"].vpq == 1.0
    assert (counts["far"].pairs, counts["far"].false, counts["far"].missed) == (0, 1, 1)  # IoU 4 / 20
    assert counts["far"].iou == 4 / 20
    outside = empty()
    outside[0, 130, 100] = 1  # the first row beyond
    assert math.isnan(count_instances(outside, empty(), UNIAD)["near"].vpq)
    assert count_instances(outside, empty(), UNIAD)["far"].vpq == 0.0


def test_samples_add_up_and_numbers_begin_anew() -> None:
    true, predicted = empty(), empty()
    true[:, 100:109, 100:104] = 7
    predicted[:, 100:109, 100:104] = 1
    other = np.where(predicted == 1, 9, 0)
    both = count_instances(predicted, true, UNIAD)["near"] + count_instances(other, true, UNIAD)["near"]
    assert (both.pairs, both.false, both.missed, both.vpq) == (10, 0, 0, 1.0)


def test_other_shapes_and_negative_numbers_are_errors() -> None:
    with pytest.raises(
        InputError, match=r"predicted instances of shape \(5, 200, 200\), got \(4, 200, 200\)"
    ):
        count_instances(empty()[:4], empty()[:4], UNIAD)
    with pytest.raises(InputError, match="true instances have numbers below 0: -20"):
        count_instances(empty(), empty() - 20, UNIAD)


SMALL = dataclasses.replace(UNIAD, cells=24, ranges={"near": (6, 18), "far": (0, 24)})


def random_sample(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles that move; the prediction shifts, drops and renumbers them."""
    true, predicted = np.zeros((2, 5, 24, 24), np.int64)
    for instance in range(1, 7):
        row, column, height, width = *rng.integers(0, 18, 2), *rng.integers(2, 8, 2)
        number, move = instance + int(rng.integers(0, 3)), rng.integers(-2, 3, 2)
        for t in range(5):
            r, c = np.maximum(np.array([row, column]) + t * move, 0)
            true[t, r : r + height, c : c + width] = 3 * instance
            if rng.random() < 0.2:
                number = int(rng.integers(1, 12))
            if rng.random() < 0.85:
                dr, dc = np.maximum(np.array([r, c]) + rng.integers(-1, 2, 2), 0)
                predicted[t, dr : dr + height, dc : dc + width] = number
    return predicted, true


def literal(predicted: np.ndarray, true: np.ndarray) -> InstanceCounts:
    """The count of FIERY's code, one pair of masks at a time."""
    pairs = false = missed = 0
    iou_sum, mapping = 0.0, dict[int, int]()
    for t in range(len(true)):
        matched_true, matched_predicted = set(), set()
        for instance in range(1, int(true.max()) + 1):
            for number in range(1, int(predicted.max()) + 1):
                a, b = true[t] == instance, predicted[t] == number
                union = int((a | b).sum())
                if not a.any() or not b.any() or not int((a & b).sum()) / union > 0.5:
                    continue
                matched_true.add(instance)
                matched_predicted.add(number)
                if instance in mapping and mapping[instance] != number:
                    false, missed = false + 1, missed + 1
                else:
                    pairs, iou_sum = pairs + 1, iou_sum + int((a & b).sum()) / union
                mapping[instance] = number
        missed += len(set(true[t][true[t] > 0].tolist()) - matched_true)
        false += len(set(predicted[t][predicted[t] > 0].tolist()) - matched_predicted)
    foreground, found = true > 0, predicted > 0
    cells = [int(mask.sum()) for mask in (foreground & found, found & ~foreground, foreground & ~found)]
    return InstanceCounts(*cells, pairs, iou_sum, false, missed)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_random_samples_as_counted_literally(seed: int) -> None:
    predicted, true = random_sample(np.random.default_rng(seed))
    found = count_instances(predicted, true, SMALL)
    for name, (first, end) in SMALL.ranges.items():
        expected = literal(predicted[:, first:end, first:end], true[:, first:end, first:end])
        assert dataclasses.astuple(found[name]) == pytest.approx(dataclasses.astuple(expected), abs=1e-12)


def test_torchmetrics_agrees_on_single_frames() -> None:
    """Panoptic quality of one frame has no numbers to change; the ground is its other class."""
    protocol: InstanceProtocol = dataclasses.replace(SMALL, future_frames=0, ranges={"all": (0, 24)})
    rng = np.random.default_rng(8)
    ours: InstanceCounts | None = None
    oracle = PanopticQuality(things={1}, stuffs={0}, return_per_class=True)
    for _ in range(6):
        predicted, true = random_sample(rng)
        for t in range(5):
            counts = count_instances(predicted[t : t + 1], true[t : t + 1], protocol)["all"]
            ours = counts if ours is None else ours + counts
            pair = [
                torch.from_numpy(np.stack([m[t] > 0, m[t]], axis=-1).astype(np.int64))
                for m in (predicted, true)
            ]
            oracle.update(pair[0][None], pair[1][None])
    assert ours is not None
    of_vehicles = oracle.compute()[0, 0].item()  # things come first
    assert ours.vpq == pytest.approx(of_vehicles, abs=1e-6)


def rasters(true: np.ndarray, valid: list[list[bool]], cell_m: float = 0.5) -> InstanceRaster:
    spec = PlaneSpec((-50.0, -50.0), cell_m, (200, 200))
    return InstanceRaster(spec, torch.from_numpy(true), torch.tensor(valid), 0.5)


def test_samples_without_their_whole_future_or_past_are_skipped() -> None:
    true = np.stack([empty()] * 3)
    true[:, :, 100:109, 100:104] = 7
    predicted = torch.from_numpy(true.copy())
    predicted[1] = 0  # the second prediction is wrong; its last step has no truth
    truth = rasters(true, [[True] * 5, [True] * 4 + [False], [True] * 5])
    counted = count_rasters(predicted, truth, 2, UNIAD)
    assert (counted["near"].pairs, counted["near"].missed) == (10, 0)
    assert count_rasters(predicted, truth, 1, UNIAD) == {}
    with pytest.raises(InputError, match=r"UniAD counts cells of 0.5 m and steps of 0.5 s, .* has 1.0 m and"):
        count_rasters(predicted, rasters(true, [[True] * 5] * 3, cell_m=1.0), 2, UNIAD)
