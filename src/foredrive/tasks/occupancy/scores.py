"""Voxel occupancy and flow against labels, and the occupancy prior.

Counts are summed over a data set before any ratio is taken. Voxels that no beam has seen (`known` False) are
left out. Height is measured in the ego frame, whose origin lies on the ground under the rear axle. "Above
ground" are voxels whose centre is more than 0.4 m above its plane z = 0, which on a slope is not quite the
road.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.errors import InputError
from foredrive.scene import VoxelGrid, VoxelSpec
from foredrive.scene.record import Record
from foredrive.scene.voxels import MOVING_MPS

ABOVE_GROUND_M = 0.4


def above_ground(spec: VoxelSpec, height_m: float = ABOVE_GROUND_M) -> Bool[Tensor, "Z Y X"]:
    """Return the voxels whose centre lies more than `height_m` above the plane z = 0 of the ego frame."""
    return spec.centres_m()[..., 2] > height_m


@dataclass(frozen=True)
class OccupancyCounts(Record):
    """Agreement of predicted with labelled occupancy, per frame."""

    true_positive: Int[Tensor, "F"]
    false_positive: Int[Tensor, "F"]
    false_negative: Int[Tensor, "F"]

    def __add__(self, other: "OccupancyCounts") -> "OccupancyCounts":
        return OccupancyCounts(
            self.true_positive + other.true_positive,
            self.false_positive + other.false_positive,
            self.false_negative + other.false_negative,
        )

    @property
    def iou(self) -> Float[Tensor, "F"]:
        """Intersection over union; NaN where neither truth nor prediction has an occupied voxel."""
        # 0 / 0 is NaN: nothing to find
        return self.true_positive / (self.true_positive + self.false_positive + self.false_negative)

    @property
    def precision(self) -> Float[Tensor, "F"]:
        """Share of occupied voxels among the predicted ones; NaN where none was predicted."""
        return self.true_positive / (self.true_positive + self.false_positive)

    @property
    def recall(self) -> Float[Tensor, "F"]:
        """Share of predicted voxels among the occupied ones; NaN where none is occupied."""
        return self.true_positive / (self.true_positive + self.false_negative)


def count_occupancy(
    predicted: Bool[Tensor, "b F Z Y X"], labels: VoxelGrid, region: Bool[Tensor, "*_r Z Y X"] | None = None
) -> OccupancyCounts:
    """Compare predicted occupancy with labels [b F 1 Z Y X] on known voxels, of `region` only if given."""
    occupied = labels.values[:, :, 0] > 0.5
    # Unknown voxels count nowhere
    known = labels.known if region is None else labels.known & region.to(labels.known.device)

    def count(where: Tensor) -> Int[Tensor, "F"]:
        return (where & known).sum(dim=(0, 2, 3, 4)).cpu()

    return OccupancyCounts(
        count(predicted & occupied), count(predicted & ~occupied), count(~predicted & occupied)
    )


class OccupancyPrior:
    """Frequency of occupancy of each voxel where it was known, over a training set; a grid per frame.

    It is the baseline of a model that looks: `best_grid` is the one fixed grid that scores best on the
    training set.
    """

    def __init__(self, frames: int, spec: VoxelSpec) -> None:
        self.spec = spec
        self.occupied = torch.zeros((frames, *spec.shape_zyx), dtype=torch.int32)
        self.known = torch.zeros_like(self.occupied)

    def add(self, labels: VoxelGrid) -> None:
        """Add training labels [b F 1 Z Y X]."""
        if labels.spec != self.spec or labels.values.shape[1] != len(self.occupied):
            raise InputError(
                f"labels of {labels.values.shape[1]} frames on {labels.spec} do not fit a prior of "
                f"{len(self.occupied)} frames on {self.spec}"
            )
        # Frequencies count over the frames in which a voxel was known
        self.occupied += ((labels.values[:, :, 0] > 0.5) & labels.known).sum(dim=0).to(self.occupied)
        self.known += labels.known.sum(dim=0).to(self.known)

    @property
    def probability(self) -> Float[Tensor, "F Z Y X"]:
        """Relative frequency of occupancy; 0 for a voxel that was never known."""
        return self.occupied / self.known.clamp_min(1)

    def best_grid(
        self, region: Bool[Tensor, "Z Y X"] | None = None
    ) -> tuple[Bool[Tensor, "F Z Y X"], Float[Tensor, "F"]]:
        """Return the grid {probability ≥ threshold} of the best IoU in training, and the threshold, by frame.

        Exact: lowering the threshold adds voxels in order of probability, each with its own hits and false
        alarms; two cumulative sums score all thresholds. Where the training set had no occupied voxel, the
        grid is empty and the threshold infinite.
        """
        probability = self.probability
        where = self.known > 0 if region is None else (self.known > 0) & region
        thresholds = torch.full((len(probability),), torch.inf)
        # One threshold for each frame; voxels that were never known are left out
        for frame, (p, inside) in enumerate(zip(probability, where, strict=True)):
            hits = self.occupied[frame][inside].double()
            false_alarms = self.known[frame][inside].double() - hits
            if hits.sum() == 0:
                continue
            p_sorted, order = p[inside].sort(descending=True)
            # IoU of the k most probable voxels: their hits over all occupied ones plus their false alarms
            iou = hits[order].cumsum(0) / (hits.sum() + false_alarms[order].cumsum(0))
            # A threshold cuts between different probabilities only: at the end of each run of equal ones
            ends_tie = torch.cat([p_sorted[1:] < p_sorted[:-1], p_sorted.new_ones(1, dtype=torch.bool)])
            thresholds[frame] = p_sorted[torch.where(ends_tie, iou, -1.0).argmax()]
        return where & (probability >= thresholds[:, None, None, None]), thresholds


@dataclass(frozen=True)
class FlowErrors(Record):
    """Sums of end-point errors over the voxels that move, per frame."""

    error_mps: Float[Tensor, "F"]
    speed_mps: Float[Tensor, "F"]
    """Error of predicting no motion."""
    voxels: Int[Tensor, "F"]

    def __add__(self, other: "FlowErrors") -> "FlowErrors":
        return FlowErrors(
            self.error_mps + other.error_mps, self.speed_mps + other.speed_mps, self.voxels + other.voxels
        )


def flow_errors(predicted_mps: Float[Tensor, "b F 3 Z Y X"], labels: VoxelGrid) -> FlowErrors:
    """Sum the end-point errors |predicted − true velocity| over known voxels faster than 0.5 m/s."""
    # Speed of the labels; voxels that stand are not counted
    speed = labels.values.norm(dim=2)
    moving = labels.known & (speed > MOVING_MPS)
    error = (predicted_mps - labels.values).norm(dim=2)

    def total(values: Tensor) -> Float[Tensor, "F"]:
        return torch.where(moving, values, 0.0).double().sum(dim=(0, 2, 3, 4)).cpu()

    return FlowErrors(total(error), total(speed), moving.sum(dim=(0, 2, 3, 4)).cpu())
