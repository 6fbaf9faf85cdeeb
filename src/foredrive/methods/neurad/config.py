"""Settings of a neural field."""

from dataclasses import dataclass, field
from typing import Literal

from foredrive.methods.neurad.sampling import Resampling


@dataclass(frozen=True)
class GridConfig:
    """A hash grid (see `ops.hash_grid.grid_levels`)."""

    levels: int
    """Number of levels."""
    features: int
    """Number of features of a level."""
    coarsest: int
    """Cells along a side of the first level."""
    finest: int
    """Cells along a side of the last level."""
    log2_rows: int
    """Binary logarithm of the maximum number of rows of a level."""


@dataclass(frozen=True)
class GridsConfig:
    """The grid of what stands and the grid that all actors share. Levels of actors are the first levels."""

    static: GridConfig
    """Grid of what stands."""
    actors: GridConfig
    """Grid that all actors share."""

    def __post_init__(self) -> None:
        """Check that actors have no more features than what stands."""
        sizes = [grid.levels * grid.features for grid in (self.static, self.actors)]
        if sizes[1] > sizes[0]:
            raise ValueError(f"actors have {sizes[1]} features, more than the static part's {sizes[0]}")


@dataclass(frozen=True)
class FieldConfig:
    """Parts of a `NeuralField`. The defaults are NeuRAD's sizes; CHOICES.md lists what differs."""

    grids: GridsConfig = field(
        default_factory=lambda: GridsConfig(
            static=GridConfig(levels=8, features=4, coarsest=32, finest=8192, log2_rows=22),
            actors=GridConfig(levels=4, features=4, coarsest=64, finest=1024, log2_rows=17),
        )
    )
    proposals: tuple[GridsConfig, ...] = field(
        default_factory=lambda: (
            (
                GridsConfig(
                    static=GridConfig(levels=6, features=1, coarsest=128, finest=4096, log2_rows=20),
                    actors=GridConfig(levels=4, features=1, coarsest=64, finest=1024, log2_rows=15),
                ),
            )
            * 2
        )
    )
    """Grids of the proposal densities, in the order of sampling."""
    proposal_samples: tuple[int, ...] = (128, 64)
    """Samples on a ray in each round of proposals."""
    samples: int = 32
    """Samples on a ray at which the field is evaluated."""
    resampling: Resampling = "greedy"
    """Rule by which samples are drawn from the weights of a proposal."""
    spacing_m: float = 20.0
    """The first samples are uniform in t / (t + spacing): the power spacing of Zip-NeRF with λ = -1."""
    sky_m: float = 20_000.0
    """End of every ray, m. What the ray has left there is given to its last sample."""
    scale_m: float | None = None
    """Half side of the cube about the path's middle that is not contracted, m; None: it holds all places up
    to 80 m ahead of and behind the path and 60 m beside it, as in the reference implementation."""
    actor_scale_m: float = 10.0
    """The same as `scale_m` for the boxes of actors, about the box' centre."""
    actor_margin_m: tuple[float, float, float] = (0.25, 0.25, 0.1)
    """The boxes of actors are this much larger at each end, m: along, across, up."""
    surface: Literal["sdf", "density"] = "sdf"
    """The field's geometry: a signed distance, with opacity 1 / (1 + exp(β s)), or a density."""
    shading: Literal["samples", "rays"] = "samples"
    """Where directions enter: at each sample, as in the paper, or once a ray, after its samples' sum."""
    beta: float = 20.0
    """Initial slope β of the opacity."""
    biases: bool = True
    """The layers of the field have biases. Those of tiny-cuda-nn have none."""
    width: int = 32
    """Channels of hidden layers and of the field's features."""
    geometry_layers: int = 2
    """Number of layers from the grid's features to the geometry."""
    feature_layers: int = 3
    """Number of layers from there, with directions, to the field's features."""
    appearance: int = 16
    """Size of a sensor's appearance code."""

    def __post_init__(self) -> None:
        """Check that each round of proposals has a number of samples, and that rays have samples."""
        rounds, given = len(self.proposals), len(self.proposal_samples)
        if not rounds or rounds != given:
            raise ValueError(
                f"{rounds} proposals and {given} numbers of proposal_samples: one for each, 1 or more"
            )
        if min(*self.proposal_samples, self.samples) < 2:
            raise ValueError("a ray needs two samples or more in each round: the last one is the sky")
