"""Ground truth of map tasks: polylines and raster layers around the ego vehicle."""

import enum
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from foredrive.scene.record import Record


class ElementKind(enum.IntEnum):
    """Kinds of map elements, in the order of MapTR's classes."""

    DIVIDER = 0
    """Line between lanes, or between directions."""
    CROSSING = 1
    """Outline of a pedestrian crossing."""
    BOUNDARY = 2
    """Border of the drivable area."""
    CENTRELINE = 3
    """Middle of a lane, in its direction of travel."""


@dataclass(frozen=True)
class MapElements(Record):
    """E polylines of at most V vertices in a patch around the ego vehicle, in the ego frame at now.

    A closed line has its first vertex at its end again. Vertices are where the line bends, not at even
    distances.
    """

    vertices: Float[Tensor, "*b E V 2"]
    """Vertices, m."""
    valid: Bool[Tensor, "*b E V"]
    kind: Int[Tensor, "*b E"]
    """An `ElementKind`, or -1 for padding."""
    known: Bool[Tensor, "*b"]
    """False if the log has no map. Then there are no elements, and nothing can be judged."""


class RasterLayer(enum.IntEnum):
    """Layers of a `MapRaster`: lines in the order of UniAD's classes, and an area."""

    DIVIDER = 0
    CROSSING = 1
    BOUNDARY = 2
    """UniAD's "contour"."""
    DRIVABLE = 3


@dataclass(frozen=True)
class PlaneSpec:
    """Position and resolution of a grid in the plane of the ego frame. The index order is Y, X."""

    lower_m: tuple[float, float]
    """x, y of the grid's lower corner, m."""
    cell_m: float
    shape_yx: tuple[int, int]

    @property
    def upper_m(self) -> tuple[float, float]:
        """Return x, y of the grid's upper corner, m."""
        (x, y), (height, width) = self.lower_m, self.shape_yx
        return (x + width * self.cell_m, y + height * self.cell_m)


@dataclass(frozen=True)
class MapRaster(Record):
    """Layers of a map on a grid in the ego frame at now."""

    spec: PlaneSpec
    layers: Bool[Tensor, "*b L Y X"]
    """By `RasterLayer`."""
    known: Bool[Tensor, "*b"]
    """False if the log has no map."""


@dataclass(frozen=True)
class InstanceRaster(Record):
    """Vehicles seen from above, now and later, on a grid in the ego frame at now. Step 0 is now.

    A vehicle's cells are those that UniAD draws, about a cell more in each direction than its box.
    """

    spec: PlaneSpec
    track_id: Int[Tensor, "*b S Y X"]
    """Track id + 1 of the vehicle at each cell, 0 where there is none."""
    valid: Bool[Tensor, "*b S"]
    """False where the log is not annotated at the time of the step. The cells hold 0."""
    dt_s: float
