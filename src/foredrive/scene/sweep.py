"""One revolution of a spinning lidar."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record


@dataclass(frozen=True)
class LidarSweep(Record):
    """N beams, hits and misses alike, padded to N; padding has `valid` False.

    In a `Clip` the leading dimensions are [b T], and the ego frame is the one of the frame's time: beams
    are motion-compensated. Misses are kept because free space and ray drop need them; a log that stores
    returns only has none, which `misses_known` of the clip says.
    """

    origin_ego: Float[Tensor, "*b N 3"]
    """Where the beam left the sensor, m."""
    dir_ego: Float[Tensor, "*b N 3"]
    """Unit direction."""
    range_m: Float[Tensor, "*b N"]
    """Distance to the return; for a miss the range up to which the beam is known to be free (0: unknown)."""
    returned: Bool[Tensor, "*b N"]
    intensity: Float[Tensor, "*b N"]
    """0 to 1; 0 for a miss."""
    dt_s: Float[Tensor, "*b N"]
    """Firing time relative to the frame's time."""
    beam: Int[Tensor, "*b N"]
    """Channel number, -1 where the log does not say."""
    valid: Bool[Tensor, "*b N"]

    @property
    def points_ego(self) -> Float[Tensor, "*b N 3"]:
        """End points of the beams in the ego frame, m; meaningful where `returned & valid`."""
        return self.origin_ego + self.dir_ego * self.range_m[..., None]
