"""The head of the map: polylines by queries, raster layers by convolutions."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from foredrive.models.tasks.agents import spread_points
from foredrive.models.tasks.decoder import DecoderConfig, PlaceEmbedding, QueryDecoderLayer
from foredrive.models.tasks.plane import Plane, PlaneFeatures, cell_middles
from foredrive.scene.agents import MapLines
from foredrive.scene.map_elements import PlaneSpec, RasterLayer
from foredrive.scene.record import Record


@dataclass(frozen=True)
class MapHeadConfig:
    """Sizes of a `MapHead`. The defaults are for towns on two cores."""

    elements: int = 20
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

    Args:
        plane: the module that makes the planes.
        config: sizes.
    """

    def __init__(self, plane: PlaneFeatures, config: MapHeadConfig) -> None:
        super().__init__()
        width = plane.width
        self.element = nn.Parameter(torch.randn(config.elements, 1, width))
        self.point = nn.Parameter(torch.randn(config.points, width))
        middle = spread_points(plane, config.elements)[:, None]
        line = torch.linspace(-1, 1, config.points)[:, None] * torch.tensor([2 * plane.cell_m, 0.0])
        self.start_m = nn.Parameter(middle + line)
        self.place = PlaceEmbedding(width)
        self.read = nn.Linear(width, width)
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

    def forward(self, plane: Plane) -> list[MapSet]:
        """Return the elements after each layer."""
        batch, cells = len(plane.features), plane.cells
        cell_place = self.place(plane.share(plane.middle_m))[None]
        queries = (self.element + self.point).expand(batch, -1, -1, -1)
        at_m = self.start_m.expand(batch, -1, -1, -1)
        found = []
        for layer in self.layers:
            queries = queries + self.read(plane.at(at_m))
            place = self.place(plane.share(at_m)).flatten(1, 2)
            queries = layer(queries.flatten(1, 2), place, cells, cell_place).view_as(queries)
            points = at_m + plane.cell_m * self.shift(queries)
            features = queries.mean(dim=2)
            found.append(MapSet(self.kind(features), points, features))
            at_m = points.detach()
        return found


@dataclass(frozen=True)
class RasterHeadConfig:
    """Sizes of a `RasterHead`."""

    width: int = 16


class RasterHead(nn.Module):
    """Convolutions from the plane to the logits of each `RasterLayer` on the grid of the truth.

    Args:
        plane: the module that makes the planes.
        spec: grid of the truth.
        config: sizes.
    """

    middle_m: Tensor

    def __init__(self, plane: PlaneFeatures, spec: PlaneSpec, config: RasterHeadConfig) -> None:
        super().__init__()
        self.shape_yx = spec.shape_yx
        self.narrow = nn.Conv2d(plane.width, config.width, 1)
        self.refine = nn.Sequential(
            nn.Conv2d(config.width, config.width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(config.width, len(RasterLayer), 3, padding=1),
        )
        final = self.refine[-1]
        assert isinstance(final, nn.Conv2d)
        assert final.bias is not None
        nn.init.constant_(final.bias, -2.0)  # lines cover little of the ground
        middle = cell_middles(spec.lower_m, spec.cell_m, spec.shape_yx)
        self.register_buffer("middle_m", middle, persistent=False)

    def forward(self, plane: Plane) -> Float[Tensor, "b L Y X"]:
        """Return the logits. Outside of the plane, features are 0."""
        small = Plane(F.relu(self.narrow(plane.features)), plane.lower_m, plane.cell_m)
        fine = small.at(self.middle_m.expand(len(plane.features), -1, -1)).mT.unflatten(-1, self.shape_yx)
        logits: Tensor = self.refine(fine)
        return logits
