"""Networks of a neural field: grids, layers and the density that proposes samples.

Values of N samples are kept with the samples last, [C N], as `ops.hash_grid` gives them: layers multiply from
the left, and nothing is transposed.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from foredrive.methods.neurad.config import FieldConfig, GridConfig, GridsConfig
from foredrive.ops.hash_grid import grid_levels, read_hash_grid


def contract(
    points_m: Float[Tensor, "N 3"], footprint_m: Float[Tensor, "N"], scale_m: float
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N"]]:
    """Map space into the unit cube (Barron et al., "Mip-NeRF 360", 2022, eq. 10, with the maximum norm).

    The cube of half side `scale_m` about the origin becomes the inner half of the unit cube, without change
    of shape. What lies beyond is drawn together. A footprint shrinks by the cube root of the volume's change.

    Args:
        points_m: positions.
        footprint_m: side of the volume that each position stands for.
        scale_m: half side of the cube that keeps its shape.

    Returns:
        Positions in the unit cube, and footprints in sides of the cube.
    """
    # Inside of the cube of half side 1 (maximum norm) nothing changes
    points = points_m / scale_m
    size = points.abs().amax(-1, keepdim=True).clamp_min(1)
    inverse = 1 / size
    points = points * (2 - inverse) * inverse
    with torch.no_grad():
        # Cube root of the determinant: radial 1/s², twice tangential (2s - 1)/s²
        shrink = ((2 * size - 1) ** 2)[:, 0].pow(1 / 3) * inverse[:, 0] ** 2
        # The contracted space spans -2 to 2, so the unit cube is 4 · scale_m wide
        footprint = footprint_m / (4 * scale_m) * shrink
    return 0.25 * points + 0.5, footprint


_FIRST_FEATURE = 1e-3
"""Bound of the initial features of a grid, as in nerfstudio's PyTorch grid. Müller et al. begin with 1e-4."""
_MAX_LOG_DENSITY = 15.0
_FIRST_LOG_DENSITY = math.log(0.02)
"""Initial logarithm of a density, 1/m: a ray passes through tens of metres."""
_FIRST_DISTANCE = 0.1
"""Initial signed distance: with β = 20, a sample stops an eighth of the light. About 0 without biases."""
HARMONICS = 16
"""Number of spherical harmonics up to degree 3."""


class ActorSamples(NamedTuple):
    """The samples that lie in boxes of actors: M of the N samples."""

    sample: Int[Tensor, "M"]
    """Index of the sample."""
    slot: Int[Tensor, "M"]
    """The actor's place in the grid of actors."""
    point_m: Float[Tensor, "M 3"]
    """Position in the frame of the box."""
    direction: Float[Tensor, "M 3"]
    """Direction of the ray in that frame."""
    footprint_m: Float[Tensor, "M"]


class HashGrid(nn.Module):
    """A hash grid with its table."""

    def __init__(self, config: GridConfig, actors: int = 1) -> None:
        super().__init__()
        self.levels = grid_levels(
            config.levels, config.coarsest, config.finest, config.log2_rows, max(actors, 1)
        )
        rows = self.levels[-1].first_row + self.levels[-1].rows
        self.table = nn.Parameter(_FIRST_FEATURE * (2 * torch.rand(rows, config.features) - 1))

    def forward(
        self, points: Float[Tensor, "N 3"], footprint: Float[Tensor, "N"], slot: Int[Tensor, "N"] | None
    ) -> Float[Tensor, "C N"]:
        """Return the features at points of the unit cube."""
        return read_hash_grid(self.table, points, self.levels, footprint, slot)


class Grids(nn.Module):
    """The grid of what stands, and a grid that all actors share, as in NeuRAD."""

    def __init__(self, config: GridsConfig, field: FieldConfig, actors: int, scale_m: float) -> None:
        super().__init__()
        self.scale_m, self.actor_scale_m = scale_m, field.actor_scale_m
        self.static = HashGrid(config.static)
        self.actors = HashGrid(config.actors, actors)
        self.features = config.static.levels * config.static.features

    def forward(
        self,
        points_m: Float[Tensor, "N 3"],
        footprint_m: Float[Tensor, "N"],
        moving: ActorSamples | None,
    ) -> Float[Tensor, "C N"]:
        """Return the features at samples: those of actors where a sample is in an actor's box.

        Args:
            points_m: positions relative to the middle of the scene.
            footprint_m: side of the volume that each sample stands for.
            moving: samples in boxes.
        """
        # All samples are read in the static grid; those in boxes are then replaced
        standing = self.static(*contract(points_m, footprint_m, self.scale_m), None)
        if moving is None or len(moving.sample) == 0:
            return standing
        return standing.index_copy(1, moving.sample, self.of_actors(moving))

    def of_actors(self, moving: ActorSamples) -> Float[Tensor, "C M"]:
        """Return the features at samples in boxes; those that actors do not have are 0."""
        own = self.actors(*contract(moving.point_m, moving.footprint_m, self.actor_scale_m), moving.slot)
        # The layers expect the static grid's number of features
        missing = self.features - len(own)
        return torch.cat([own, own.new_zeros(missing, own.shape[1])]) if missing else own


class Layers(nn.Module):
    """A perceptron for values with the samples last: ReLU between the layers."""

    def __init__(self, *sizes: int, bias: bool = True) -> None:
        super().__init__()
        self.linear = nn.ModuleList(nn.Linear(a, b, bias=bias) for a, b in pairwise(sizes))

    def forward(self, x: Float[Tensor, "C N"]) -> Float[Tensor, "D N"]:
        """Return the last layer's output."""
        for i, layer in enumerate(self.linear):
            x = affine(layer, x if i == 0 else x.relu_())
        return x


def affine(layer: nn.Module, x: Float[Tensor, "C N"]) -> Float[Tensor, "D N"]:
    """Apply a linear layer from the left."""
    assert isinstance(layer, nn.Linear)
    return layer.weight @ x if layer.bias is None else torch.addmm(layer.bias[:, None], layer.weight, x)


class FieldLayers(nn.Module):
    """The layers of the field: geometry and features from a grid's features and directions, as in NeuRAD."""

    def __init__(self, config: FieldConfig, features: int) -> None:
        super().__init__()
        width, bias, self.shading = config.width, config.biases, config.shading
        self.geometry = Layers(features, *[width] * (config.geometry_layers - 1), width + 1, bias=bias)
        self.first = nn.Linear(width, width, bias=bias)
        self.first_direction = nn.Linear(HARMONICS, width, bias=False)
        self.rest = Layers(*[width] * config.feature_layers, bias=bias)
        self.beta = nn.Parameter(torch.tensor(config.beta)) if config.surface == "sdf" else None
        with torch.no_grad():
            last = self.geometry.linear[-1]
            assert isinstance(last, nn.Linear)
            # The signed distance starts near a constant
            last.weight[0] *= _FIRST_DISTANCE
            if bias:
                last.bias[0] = _FIRST_DISTANCE if self.beta is not None else 0.0

    def surface(
        self, grid: Float[Tensor, "C N"], length_m: Float[Tensor, "R S"]
    ) -> tuple[Float[Tensor, "R S"], Float[Tensor, "D R S"]]:
        """Return the opacity and the embedding of S samples on each of R rays (N = R · S).

        Args:
            grid: features of the grids.
            length_m: lengths of the samples' intervals.
        """
        # Channel 0 is the signed distance or log density, the others are the embedding
        out = self.geometry(grid)
        return self._opacity(out[0].view(length_m.shape), length_m), out[1:].unflatten(1, length_m.shape)

    def seen(
        self,
        embedding: Float[Tensor, "D R S"],
        weight: Float[Tensor, "R S"],
        direction: Float[Tensor, "R 3"],
        moving: ActorSamples | None,
    ) -> Float[Tensor, "D R"]:
        """Return the features that rays see: the weighted sums over their samples.

        Args:
            embedding: of the samples, from `surface`.
            weight: weights of the samples; they add up to 1.
            direction: directions of the rays.
            moving: samples in boxes; their directions are those in the box' frame.
        """
        # Directions enter linearly, so their part is computed once for each ray
        turned = self.first_direction.weight @ harmonics(direction)  # [D R]
        if self.shading == "samples":
            hidden = affine(self.first, embedding.flatten(1)).unflatten(1, weight.shape) + turned[..., None]
            hidden = self._turned_back(hidden.flatten(1), direction, moving, weight, sums=False)
            feature = embedding + self.rest(hidden.relu_()).unflatten(1, weight.shape)
            return (feature * weight).sum(-1)
        # The first layer is linear, so it can be applied to the sums.
        embedded = (embedding * weight).sum(-1)
        hidden = affine(self.first, embedded) + turned
        hidden = self._turned_back(hidden, direction, moving, weight, sums=True)
        return embedded + self.rest(hidden.relu())

    def _turned_back(
        self,
        hidden: Float[Tensor, "D M"],
        direction: Float[Tensor, "R 3"],
        moving: ActorSamples | None,
        weight: Float[Tensor, "R S"],
        sums: bool,
    ) -> Float[Tensor, "D M"]:
        """Replace the directions of rays by those in boxes, for samples or for their weighted sums."""
        if moving is None or len(moving.sample) == 0:
            return hidden
        ray = moving.sample // weight.shape[1]
        # Actors see the ray in the frame of their box: replace the harmonics of those samples
        along_ray = harmonics(direction.index_select(0, ray))  # see `ops.ray_boxes` on index_select
        change = self.first_direction.weight @ (harmonics(moving.direction) - along_ray)
        if sums:
            return hidden.index_add(1, ray, change * weight.flatten()[moving.sample])
        return hidden.index_add(1, moving.sample, change)

    def _opacity(
        self, geometry: Float[Tensor, "R S"], length_m: Float[Tensor, "R S"]
    ) -> Float[Tensor, "R S"]:
        if self.beta is not None:
            # The slope stays positive, and above 0
            return torch.sigmoid(-(self.beta.abs() + 1e-4) * geometry)
        return opacity_of_density(geometry, length_m)


def opacity_of_density(
    log_density: Float[Tensor, "R S"], length_m: Float[Tensor, "R S"]
) -> Float[Tensor, "R S"]:
    """Return 1 - exp(-σ δ) for log σ - log σ₀ with the initial density σ₀, and lengths δ."""
    # The bound keeps the exponential finite
    density = (log_density + _FIRST_LOG_DENSITY).clamp_max(_MAX_LOG_DENSITY).exp()
    # expm1 is exact for small densities
    return -torch.expm1(-density * length_m)


class ProposalDensity(nn.Module):
    """A density from a small grid, which only says where to sample the field."""

    def __init__(self, config: GridsConfig, field: FieldConfig, actors: int, scale_m: float) -> None:
        super().__init__()
        self.grids = Grids(config, field, actors, scale_m)
        self.decoder = nn.Linear(self.grids.features, 1, bias=False)

    def forward(
        self,
        points_m: Float[Tensor, "N 3"],
        footprint_m: Float[Tensor, "N"],
        moving: ActorSamples | None,
        length_m: Float[Tensor, "R S"],
    ) -> Float[Tensor, "R S"]:
        """Return the opacity of samples."""
        return self._opacity(self.grids(points_m, footprint_m, moving), length_m)

    def of_actors(self, moving: ActorSamples, length_m: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
        """Return the opacity of samples that all lie in boxes."""
        return self._opacity(self.grids.of_actors(moving), length_m)

    def _opacity(self, grid: Float[Tensor, "C N"], length_m: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
        log_density = self.decoder.weight @ grid
        return opacity_of_density(log_density.view(length_m.shape), length_m)


def harmonics(direction: Float[Tensor, "R 3"]) -> Float[Tensor, "16 R"]:
    """Return the real spherical harmonics up to degree 3 of unit vectors."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479),
            -0.48860251 * y,
            0.48860251 * z,
            -0.48860251 * x,
            1.09254843 * x * y,
            -1.09254843 * y * z,
            0.31539157 * (3 * zz - 1),
            -1.09254843 * x * z,
            0.54627422 * (xx - yy),
            -0.59004359 * y * (3 * xx - yy),
            2.89061144 * x * y * z,
            -0.45704580 * y * (5 * zz - 1),
            0.37317633 * z * (5 * zz - 3),
            -0.45704580 * x * (5 * zz - 1),
            1.44530572 * z * (xx - yy),
            -0.59004359 * x * (xx - 3 * yy),
        ]
    )
