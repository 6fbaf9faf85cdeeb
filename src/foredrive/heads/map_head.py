"""The head of the map: polylines by queries, raster layers by convolutions."""

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from foredrive.heads.decoder import DecoderConfig, PlaceEmbedding, QueryDecoderLayer
from foredrive.heads.plane import Plane, PlanePyramid, Planes, cell_middles, spread_points
from foredrive.scene.agents import MapLines
from foredrive.scene.map_elements import PlaneSpec, RasterLayer
from foredrive.scene.record import Record


@dataclass(frozen=True)
class MapHeadConfig:
    """Sizes of a `MapHead`. The defaults are for towns on two cores."""

    elements: int = 50
    """Lines that are looked for, as many as in MapTR. Frames have about ten, but each line begins at one of
    these, and few of a small number are near."""
    points: int = 10
    """Points of an element."""
    kinds: int = 3
    """The first so many of `ElementKind`: 3 without centrelines."""
    decoder: DecoderConfig = field(default_factory=DecoderConfig)


@dataclass(frozen=True)
class MapSet(Record):
    """The output of the head for each of E elements, in the ego frame at now."""

    logits: Float[Tensor, "*b E K"]
    """Logit of each kind by itself. If all are low, there is no element."""
    points: Float[Tensor, "*b E P 2"]
    """Points in order along the element, m."""
    query: Float[Tensor, "*b E W"] | None = None
    """Features of each element: the mean of its points' queries."""

    def lines(self) -> MapLines:
        """Return the most probable kind of each element, with its probability as the score."""
        score, kind = self.logits.sigmoid().max(dim=-1)
        return MapLines(self.points, kind, score)


class MapHead(nn.Module):
    """Queries for each point of each element; a query is the sum of its element's and its point's embedding.

    As in MapTR (Liao et al. 2023), with plain attention. Each point refines its position from layer to layer.
    Elements may start at typical lines of the training set (`begin_at`), as in SparseDrive (Sun et al. 2024).

    Args:
        planes: the module that makes the planes.
        config: sizes.
    """

    def __init__(self, planes: PlanePyramid, config: MapHeadConfig) -> None:
        super().__init__()
        width = planes.width
        self.step_m = planes.coarse_m
        self.element = nn.Parameter(torch.randn(config.elements, 1, width))
        self.point = nn.Parameter(torch.randn(config.points, width))
        # Elements start as short lines, spread evenly over the plane
        middle = spread_points(planes.lower_m, planes.cell_m, planes.shape_yx, config.elements)[:, None]
        line = torch.linspace(-1, 1, config.points)[:, None] * torch.tensor([2 * planes.coarse_m, 0.0])
        self.start_m = nn.Parameter(middle + line)
        self.place = PlaceEmbedding(width)
        self.read = nn.Linear(planes.fine_width, width)
        self.layers = nn.ModuleList(
            QueryDecoderLayer(width, config.decoder) for _ in range(config.decoder.layers)
        )
        self.shift = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 2)
        )
        self.kind = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.kinds))
        final = self.kind[-1]
        assert isinstance(final, nn.Linear)
        nn.init.constant_(final.bias, -2.0)  # most elements are empty

    @torch.no_grad()
    def begin_at(self, lines_m: Float[Tensor, "E P 2"]) -> None:
        """Start the elements at these lines; without this call, they are short and spread over the plane."""
        self.start_m.copy_(lines_m)

    def forward(self, planes: Planes) -> list[MapSet]:
        """Return the elements after each layer."""
        fine, cells = planes.fine, planes.coarse.cells
        batch = len(cells)
        cell_place = self.place(planes.coarse.share(planes.coarse.middle_m))[None]
        queries = (self.element + self.point).expand(batch, -1, -1, -1)
        at_m = self.start_m.expand(batch, -1, -1, -1)
        layers = []
        for layer in self.layers:
            # Each point reads the plane at its own position
            queries = queries + self.read(fine.at(at_m))
            place = self.place(fine.share(at_m)).flatten(1, 2)
            # All points of all elements attend to each other as one sequence
            queries = layer(queries.flatten(1, 2), place, cells, cell_place).view_as(queries)
            points = at_m + self.step_m * self.shift(queries)
            # The kind and features of an element come from the mean of its points
            features = queries.mean(dim=2)
            layers.append(MapSet(self.kind(features), points, features))
            # Each layer moves fixed points: gradients do not run through earlier layers
            at_m = points.detach()
        return layers


@dataclass(frozen=True)
class RasterHeadConfig:
    """Sizes of a `RasterHead`."""

    width: int = 16
    """Channels of the fine part."""


class RasterHead(nn.Module):
    """Convolutions from the planes to the logits of each `RasterLayer` on the grid of the truth.

    The truth may reach farther than the planes. So the coarse plane is first continued to the extent of the
    truth, by convolutions with growing strides: roads go on. Inside, the fine plane is added. Each cell
    then predicts 2 x 2 cells (sub-pixel convolution, Shi et al. 2016), which are read at the truth's.

    Args:
        planes: the module that makes the planes.
        spec: grid of the truth.
        config: sizes.
    """

    middle_m: Tensor
    coarse_m: Tensor
    fine_m: Tensor

    def __init__(self, planes: PlanePyramid, spec: PlaneSpec, config: RasterHeadConfig) -> None:
        super().__init__()
        wide, width = planes.width, config.width
        self.spec = spec
        self.continued = nn.Sequential(
            nn.Conv2d(wide + 1, wide // 2, 1),
            nn.ReLU(),
            *(part for stride in (1, 2, 4, 8) for part in _dilated(wide // 2, stride)),
            nn.Conv2d(wide // 2, width, 1),
        )
        self.narrow = nn.Conv2d(planes.fine_width + 1, width, 1)
        self.refine = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), nn.ReLU()
        )
        self.out = nn.Conv2d(width, 4 * len(RasterLayer), 1)
        assert self.out.bias is not None
        nn.init.constant_(self.out.bias, -2.0)  # lines cover little of the ground
        # Canvases of whole cells over the extent of the truth.
        rows, columns = (math.ceil(size * spec.cell_m / planes.coarse_m) for size in spec.shape_yx)
        times = round(planes.coarse_m / planes.cell_m)
        self.fine_shape, self.coarse_shape = (times * rows, times * columns), (rows, columns)
        self.cell_m = planes.cell_m
        grids = {
            "coarse_m": cell_middles(spec.lower_m, planes.coarse_m, self.coarse_shape),
            "fine_m": cell_middles(spec.lower_m, planes.cell_m, self.fine_shape),
            "middle_m": cell_middles(spec.lower_m, spec.cell_m, spec.shape_yx),
        }
        for name, grid in grids.items():
            self.register_buffer(name, grid, persistent=False)

    def forward(self, planes: Planes) -> Float[Tensor, "b L Y X"]:
        """Return the logits."""
        # Beyond the plane, convolutions of growing reach continue what leads out of it
        far = self.continued(_on_canvas(planes.coarse, self.coarse_m, self.coarse_shape))
        far = F.interpolate(far, size=self.fine_shape, mode="bilinear")
        near = self.narrow(_on_canvas(planes.fine, self.fine_m, self.fine_shape))
        # Each cell gives 2 x 2 finer cells
        logits = F.pixel_shuffle(self.out(self.refine(F.relu(far + near))), 2)
        plane = Plane(logits, self.spec.lower_m, self.cell_m / 2)
        # Read at the middles of the truth's cells, whose size may differ
        at_middles = plane.at(self.middle_m.expand(len(logits), -1, -1))
        return at_middles.mT.unflatten(-1, self.spec.shape_yx)


def _dilated(width: int, stride: int) -> tuple[nn.Module, ...]:
    return (
        nn.Conv2d(width, width, 3, padding=stride, dilation=stride),
        nn.GroupNorm(8, width),
        nn.ReLU(),
    )


def _on_canvas(
    plane: Plane, middle_m: Float[Tensor, "C 2"], shape_yx: tuple[int, int]
) -> Float[Tensor, "b W_1 y x"]:
    """Return features at cells of a larger grid, 0 outside of the plane; the last channel is 1 inside."""
    inside = Plane(torch.ones_like(plane.features[:, :1]), plane.lower_m, plane.cell_m)
    points_m = middle_m.expand(len(plane.features), -1, -1)
    drawn = torch.cat([plane.at(points_m), inside.at(points_m)], dim=-1)
    return drawn.mT.unflatten(-1, shape_yx)
