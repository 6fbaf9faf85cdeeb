"""The interface between models and evaluations: a `Predictor` returns a `Prediction`."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from foredrive.scene import Agent, Clip, Trajectory
from foredrive.scene.agents import Agents, MapLines
from foredrive.scene.record import Record

Part = Literal[
    "occupancy_logit",
    "plan",
    "flow_mps",
    "futures",
    "images",
    "agents",
    "map_lines",
    "map_layers",
    "semantics",
    "instances",
]
"""A part of a `Prediction`, by the name of its field."""


@dataclass(frozen=True)
class Prediction(Record):
    """A model's predictions for b clips and F frames: now, then future key frames. None is not judged.

    Images may be rendered of fewer frames, R.
    """

    occupancy_logit: Float[Tensor, "b F Z Y X"] | None = None
    """Each frame in its own (predicted) ego frame, on the labels' grid."""
    plan: Trajectory | None = None
    """[b 1 T] in the ego frame at now."""
    flow_mps: Float[Tensor, "b F 3 Z Y X"] | None = None
    """Velocity over ground of the content of a voxel, in the ego axes of its frame."""
    futures: Bool[Tensor, "b K P Z Y X"] | None = None
    """Occupancy in K sampled futures, of the P = F - 1 key frames after now."""
    images: Float[Tensor, "b R C 3 h w"] | None = None
    """Rendered views of the clip's cameras, RGB from 0 to 1."""
    agents: Agents | None = None
    """Road users at now."""
    map_lines: MapLines | None = None
    map_layers: Float[Tensor, "b L H W"] | None = None
    """Probability of each `RasterLayer` on the grid of the truth."""
    semantics: UInt8[Tensor, "b Z Y X"] | None = None
    """Index of the class of each voxel, in the classes and on the grid of the truth."""
    instances: Int[Tensor, "b S _Y _X"] | None = None
    """Number + 1 of the vehicle at each cell now and later, the same over time, on the grid of the truth."""
    image_stride: int = 1
    """One pixel in `image_stride` along rows and columns is rendered, the first at `image_stride // 2`."""


@runtime_checkable
class Predictor(Protocol):
    """A model under evaluation."""

    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        """Predict from a batch of clips that end at now; their driven future is masked.

        Args:
            observed: of b clips.
            asked: parts that the metrics need. A part that is not asked for may be left None, and so may a
                part that the model cannot predict.
        """
        ...


@runtime_checkable
class DriveFollowing(Protocol):
    """A `Predictor` that carries something from frame to frame of a drive."""

    def follow(self, keys: Sequence[str]) -> None:
        """Receive the names, LOG@T_US, of the clips that `predict` is given next, in the order of time."""
        ...


@dataclass(frozen=True)
class PlannerPredictor:
    """A planner as a `Predictor`: it predicts a plan and nothing else."""

    planner: Agent

    def predict(self, observed: Clip, asked: frozenset[Part]) -> Prediction:
        """Return the plan alone."""
        return Prediction(plan=self.planner.act(observed))
