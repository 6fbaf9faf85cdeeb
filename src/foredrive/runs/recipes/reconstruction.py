"""Recipes for reconstructing logs: what is common to all representations of a scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from foredrive.engine.config import read_values, validated
from foredrive.engine.ranges import check_at_least
from foredrive.errors import InputError
from foredrive.methods.neurad.recipes import FieldRecipe, base_field, tiny_field
from foredrive.methods.recipe import rescheduled
from foredrive.methods.reconstruction.representation import Representation
from foredrive.methods.reconstruction.tracks import MOVES_M
from foredrive.methods.splatad.recipes import (
    GaussianRecipe,
    base_gaussians,
    published_gaussians,
    small_gaussians,
    tiny_gaussians,
)

R = TypeVar("R", bound=Representation)

REPRESENTATIONS: dict[str, type[Representation]] = {
    "gaussians": GaussianRecipe,
    "field": FieldRecipe,
}
"""The representations by their `kind`: frozen dataclasses of plain values."""


@dataclass(frozen=True)
class ReconstructionRecipe(Generic[R]):
    """All settings of a reconstruction, except where the log is."""

    name: str
    image_hw: tuple[int, int]
    """Height and width of the resized images, px."""
    representation: R
    """Recipe of the scene's content and of its training; its kind is a row of `REPRESENTATIONS`."""
    cameras: tuple[str, ...] | None = None
    """Names of cameras, their own or 123D's; None takes all."""
    hold_out_every: int = 2
    """The last frame of every group of this size is held out for evaluation; 0 holds out none."""
    actors: bool = True
    """Moving objects are parts of their own, the actors. If False, everything is static."""
    moves_m: float = MOVES_M
    """Minimum standard deviation of the position of what moves, m. Tracks that move less belong to the static
    part. 0: all tracks are actors, so that parked vehicles can be removed and moved too."""
    nonrigid: bool = True
    """Pedestrians and animals that move are actors. If False, they belong to the static part."""
    drop: bool = True
    """Beams may fail to return. If False, all return."""
    about: str = field(default="", compare=False)
    """One line for lists of recipes."""

    def __post_init__(self) -> None:
        """Check the numbers' ranges."""
        check_at_least(self, moves_m=0)


def gaussians_tiny() -> ReconstructionRecipe[GaussianRecipe]:
    """Return a recipe for some minutes on two cores, with images of 480×270."""
    return ReconstructionRecipe(
        name="gaussians_tiny",
        about="a log reconstructed from Gaussians in minutes on two CPU cores",
        image_hw=(270, 480),
        representation=tiny_gaussians(),
    )


def gaussians_small() -> ReconstructionRecipe[GaussianRecipe]:
    """Return a recipe for ten minutes on one core, with images of 480×270."""
    return ReconstructionRecipe(
        name="gaussians_small",
        about="a log reconstructed from more Gaussians, in ten minutes on one CPU core",
        image_hw=(270, 480),
        representation=small_gaussians(),
    )


def gaussians_base() -> ReconstructionRecipe[GaussianRecipe]:
    """Return our version of SplatAD in its sizes, for a GPU. `gaussians_published` is nearer to it."""
    return ReconstructionRecipe(
        name="gaussians_base",
        about="our version of SplatAD in its sizes, for a GPU",
        image_hw=(1080, 1920),
        representation=base_gaussians(),
    )


def gaussians_published() -> ReconstructionRecipe[GaussianRecipe]:
    """Return SplatAD with the choices of its reference implementation, for a GPU.

    methods/splatad/CHOICES.md lists what still differs.
    """
    return ReconstructionRecipe(
        name="gaussians_published",
        about="SplatAD with the choices of its reference implementation, for a GPU",
        image_hw=(1080, 1920),
        representation=published_gaussians(),
        nonrigid=False,
    )


def field_tiny() -> ReconstructionRecipe[FieldRecipe]:
    """Return a recipe for half an hour on two cores, with images of 480×270."""
    return ReconstructionRecipe(
        name="field_tiny",
        about="a log reconstructed as a neural field in half an hour on two CPU cores",
        image_hw=(270, 480),
        representation=tiny_field(),
    )


def field_base() -> ReconstructionRecipe[FieldRecipe]:
    """Return NeuRAD in its sizes, for a GPU."""
    return ReconstructionRecipe(
        name="field_base",
        about="NeuRAD in the sizes of its reference implementation, for a GPU",
        image_hw=(1080, 1920),
        representation=base_field(),
        nonrigid=False,
    )


def rescheduled_recipe(recipe: ReconstructionRecipe[R], **changes: Any) -> ReconstructionRecipe[R]:
    """Return the recipe with changed entries of the schedule of its representation, such as `seed`."""
    return replace(recipe, representation=rescheduled(recipe.representation, **changes))


RECONSTRUCTION_RECIPES: dict[str, ReconstructionRecipe[Any]] = {
    recipe.name: recipe
    for recipe in (
        *(gaussians_tiny(), gaussians_small(), gaussians_base(), gaussians_published()),
        *(field_tiny(), field_base()),
    )
}


def load_reconstruction_recipe(path: Path) -> ReconstructionRecipe[Any]:
    """Read a recipe from YAML. Raises the errors of `load_recipe`."""
    return reconstruction_recipe_from(read_values(path), str(path))


def reconstruction_recipe_from(written: Any, source: str) -> ReconstructionRecipe[Any]:
    """Validate the plain values of a recipe. Arguments and errors are those of `recipe_from`."""
    representation = written.get("representation") if isinstance(written, Mapping) else None
    kind = representation.get("kind") if isinstance(representation, Mapping) else None
    if kind not in REPRESENTATIONS:
        names = ", ".join(REPRESENTATIONS)
        raise InputError(f"{source}: not a recipe: representation.kind: {kind!r} is none of {names}")
    row = REPRESENTATIONS[kind]
    recipe: ReconstructionRecipe[Any] = validated(ReconstructionRecipe[row], written, source)  # type: ignore[valid-type]
    return recipe
