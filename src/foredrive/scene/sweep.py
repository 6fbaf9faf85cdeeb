"""One revolution of a spinning lidar."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class LidarSweep(Record):
    """N beams, hits and misses, padded. Padding has `valid` False.

    In a `Clip` the leading dimensions are [b T]. Beams are motion-compensated to the ego frame at the time of
    the frame. Misses are kept because free space and ray drop need them. A log that stores only returns has
    no misses; then `misses_known` of the clip is False.
    """

    origin_ego: Float[Tensor, "*b N 3"]
    """Position of the sensor when it fired the beam, m."""
    dir_ego: Float[Tensor, "*b N 3"]
    """Unit direction of the beam."""
    range_m: Float[Tensor, "*b N"]
    """Distance to the return, m. For a miss, the range up to which the beam is known to be free (0 if
    unknown)."""
    returned: Bool[Tensor, "*b N"]
    intensity: Float[Tensor, "*b N"]
    """Intensity from 0 to 1; 0 for a miss."""
    dt_s: Float[Tensor, "*b N"]
    """Firing time relative to the time of the frame, s."""
    beam: Int[Tensor, "*b N"]
    """Channel number; -1 where the log has none."""
    valid: Bool[Tensor, "*b N"]

    @property
    def points_ego(self) -> Float[Tensor, "*b N 3"]:
        """Return the end points of the beams in the ego frame, m, meaningful where `returned & valid`."""
        return self.origin_ego + self.dir_ego * self.range_m[..., None]
