"""Printed recipes say what their entries mean."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml

from foredrive.cli.main import main
from foredrive.driver.recipes import DRIVER_RECIPES
from foredrive.engine.config import explained_yaml, field_helps, recipe_yaml
from foredrive.runs.recipes.known import KINDS, RECIPES, find_recipe
from foredrive.runs.recipes.reconstruction import RECONSTRUCTION_RECIPES

ALL: dict[str, Any] = {**RECIPES, **DRIVER_RECIPES, **RECONSTRUCTION_RECIPES}


@dataclass(frozen=True)
class Wheels:
    """Wheels of a vehicle.

    Args:
        size_m: Diameter of a wheel
            with its tyre, m. It is the same for all.
        count: Number of wheels (eq. 4 of the paper).
        maker: Who made them.
    """

    size_m: float
    count: int = 4
    maker: str = "one\n\ntwo"


@dataclass(frozen=True)
class Empty:
    """Nothing to set."""


@dataclass(frozen=True)
class Vehicle:
    wheels: Wheels
    """Replaced below."""


@dataclass(frozen=True)
class Car(Vehicle):
    wheels: Wheels
    colour: tuple[int, ...] = (1, 2)
    """Colour: red, green. The other is 0."""
    owner: str | None = None
    """Owner; None: unknown."""
    plate: str = "A: 1 # 2"
    """
    Text of the plate.
    """
    note: str = 'say "é"\a # twice: \u2028'
    """Words."""
    doors: dict[str, Any] = field(default_factory=lambda: {"front": (1.5, 2), "back": None})
    """Doors by their place."""
    corners: tuple[tuple[float, float], ...] = ((0.0, 1e-5), (1.0, 1e20))
    """Corners."""
    spare: Wheels = Wheels(0.5)
    """Spare wheel, with a help that is so long that it is printed above the entry and not behind it, as
    all are."""
    trunk: Empty = Empty()
    seats: int = 5
    """Number of seats, with a first sentence that is so long that even alone it does not fit into a line of a
    recipe, whichever way it is turned. This is cut."""
    bare: bool = True


EXPECTED = """\
wheels:  # Replaced below.
  size_m: 0.6  # Diameter of a wheel with its tyre, m.
  count: 4  # Number of wheels (eq. 4 of the paper).
  # Who made them.
  maker: 'one


    two'
colour: [1, 2]  # Colour: red, green.
owner: null  # Owner; None: unknown.
plate: 'A: 1 # 2'  # Text of the plate.
note: "say \\"é\\"\\a # twice: \\L"  # Words.
# Doors by their place.
doors:
  front: [1.5, 2]
  back: null
# Corners.
corners:
- [0.0, 1.0e-05]
- [1.0, 1.0e+20]
# Spare wheel, with a help that is so long that it is printed above the entry and not behind it, as all are.
spare:
  size_m: 0.5  # Diameter of a wheel with its tyre, m.
  count: 4  # Number of wheels (eq. 4 of the paper).
  # Who made them.
  maker: 'one


    two'
trunk: {}  # Nothing to set.
# Number of seats, with a first sentence that is so long that even alone it does not fit into a line of a
# recipe, whichever way it is turned.
seats: 5
bare: true
"""


def test_entries_have_their_help_behind_or_above_them() -> None:
    assert explained_yaml(Car(Wheels(0.6))) == EXPECTED


def test_a_part_without_help_has_the_first_line_of_its_class() -> None:
    @dataclass(frozen=True)
    class Cart:
        wheels: Wheels

    assert explained_yaml(Cart(Wheels(0.6))).startswith("wheels:  # Wheels of a vehicle.\n  size_m: 0.6  #")


def test_a_class_without_source_has_entries_without_help() -> None:
    made = dataclasses.make_dataclass("made", [("size_m", float)], frozen=True)
    assert explained_yaml(made(0.6)) == "size_m: 0.6\n"


@pytest.mark.parametrize("recipe", [*ALL.values(), Car(Wheels(0.6))], ids=[*ALL, "car"])
def test_explanations_leave_the_values_as_they_are(recipe: Any) -> None:
    explained = explained_yaml(recipe)
    assert repr(yaml.safe_load(explained)) == repr(yaml.safe_load(recipe_yaml(recipe)))
    comments = [line for line in explained.split("\n") if "# " in line]
    assert max(map(len, comments)) <= 110


def without_help(recipe: Any) -> Iterator[str]:
    """Names of the entries without help, here and in the parts."""
    for entry in dataclasses.fields(recipe):
        value = getattr(recipe, entry.name)
        values = value if isinstance(value, tuple) else (value,)
        nested = [part for part in values if dataclasses.is_dataclass(part)]
        for part in nested:
            yield from (f"{entry.name}.{name}" for name in without_help(part))
        explained = entry.name in field_helps(type(recipe)) or (nested and type(nested[0]).__doc__)
        if not explained and entry.name not in ("name", "kind"):
            yield entry.name


@pytest.mark.parametrize("name", ALL)
def test_every_entry_has_a_help_line(name: str) -> None:
    missing = list(without_help(ALL[name]))
    assert not missing, f"write docstrings below the fields {missing}"


def test_a_printed_recipe_can_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "own.yaml"
    for name in ("nemo_tiny", "driver_small", "gaussians_tiny"):
        main(["recipes", name])
        own.write_text(capsys.readouterr().out)
        assert "  # " in own.read_text()
        assert find_recipe(str(own), (), *KINDS) == ALL[name]
