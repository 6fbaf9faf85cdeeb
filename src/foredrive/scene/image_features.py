"""Features of the images of one key frame, with their rays."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class ImageFeatures(Record):
    """The finest level of image features of C cameras at one time. What is small is visible only here."""

    values: Float[Tensor, "b C h w D"]
    direction: Float[Tensor, "b C h w 3"]
    """Unit vectors along the rays through the middles of the cells, ego frame."""
    cell_rad: Float[Tensor, "b C"]
    """Angle between neighbouring cells in the middle of the image."""
    valid: Float[Tensor, "b C"]
    """1 for an image that exists, 0 for one that is missing."""
