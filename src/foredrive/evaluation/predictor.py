"""What an evaluation asks of whatever it judges."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.scene import Clip, Trajectory
from foredrive.scene.record import Record


@dataclass(frozen=True)
class Prediction(Record):
    """What is said about b clips, for F frames: now, then future key frames. What is None is not judged.

    Images may be rendered of fewer frames, R.
    """

    occupancy_logit: Float[Tensor, "b F Z Y X"] | None = None
    """Each frame in its own (predicted) ego frame, on the labels' grid."""
    plan: Trajectory | None = None
    """[b 1 T] in the ego frame at now."""
    flow_mps: Float[Tensor, "b F 3 Z Y X"] | None = None
    """Velocity over ground of what is in a voxel, in the ego axes of its frame."""
    futures: Bool[Tensor, "b K P Z Y X"] | None = None
    """Occupancy in K futures drawn by chance, of the P = F - 1 key frames after now."""
    images: Float[Tensor, "b R C 3 h w"] | None = None
    """Rendered views of the clip's cameras, RGB from 0 to 1."""
    image_known: Bool[Tensor, "b R C h w"] | None = None
    """Pixels that were rendered; None: all."""
    image_stride: int = 1
    """Every how many-th pixel along rows and columns was rendered, the first one `image_stride // 2` in."""


@runtime_checkable
class Predictor(Protocol):
    """A model under evaluation."""

    def predict(self, observed: Clip) -> Prediction:
        """Predict from a batch of clips that end at now; their driven future is masked."""
        ...
