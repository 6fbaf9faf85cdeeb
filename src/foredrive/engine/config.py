"""Configurations as plain values: read from YAML, validated, changed by settings, written."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.plain_yaml import parse_yaml, read_yaml


def save_recipe(recipe: Any, path: Path) -> None:
    """Write a recipe of any kind, a dataclass of plain values, as YAML."""
    with atomic_path(path) as temporary:
        temporary.write_text(recipe_yaml(recipe))


def recipe_yaml(recipe: Any) -> str:
    """Return a recipe of any kind as YAML."""
    plain = _plain(asdict(recipe))
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)


def is_recipe_file(name: str) -> bool:
    """Return whether the name of a recipe is that of a YAML file."""
    return name.endswith((".yaml", ".yml"))


def read_values(path: Path) -> Any:
    """Read YAML.

    Raises:
        InputError: the file cannot be read or is not YAML.
    """
    return read_yaml(path, "a recipe")


def validated(kind: Any, written: Any, source: str) -> Any:
    """Return plain values as a dataclass, generic or not.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names it.
    """
    try:
        return TypeAdapter(kind).validate_python(written, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{source}: not a recipe: {f'{where}: ' if where else ''}{first['msg']}") from error


def overridden(written: Mapping[str, Any], settings: Sequence[str]) -> dict[str, Any]:
    """Return plain values with some of them replaced.

    Args:
        written: the complete values of a recipe of any kind.
        settings: entries KEY.KEY=VALUE; the value is read as YAML.

    Raises:
        InputError: a setting has another form or an unknown key. The message names the nearest known key.
    """
    values: dict[str, Any] = _plain(written)
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: write KEY=VALUE, such as finetune.schedule.lr=1e-3")
        *parents, last = name.split(".")
        place: Any = values
        for depth, key in enumerate([*parents, last]):
            if not isinstance(place, Mapping):
                raise InputError(f"--set {setting}: {'.'.join(parents[:depth])} has no entries")
            if key not in place:
                raise InputError(f"--set {setting}: no entry {key!r}{_nearest(key, name, place, values)}")
            # Stop at the parent of the last key, which is assigned below
            if depth < len(parents):
                place = place[key]
        try:
            place[last] = parse_yaml(text)
        except InputError as error:
            raise InputError(f"--set {name}: {text[:100]!r} is no value: {error}") from error
    return values


def _nearest(key: str, name: str, siblings: Mapping[str, Any], values: Mapping[str, Any]) -> str:
    """Return a suggestion for an unknown key, as the end of a sentence."""
    near = difflib.get_close_matches(key, siblings, n=1)
    if near:
        return f"; {near[0]!r} is near"
    # No similar key here: prefer entries of this name elsewhere, then those with a similar full name
    everywhere = list(_names(values))
    near = [full_name for full_name in everywhere if full_name.split(".")[-1] == key]
    near = near or difflib.get_close_matches(name, everywhere, n=1, cutoff=0.4)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(siblings)}"


def _names(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Return the dotted names of all entries."""
    names = []
    for key, value in values.items():
        names.append(prefix + key)
        if isinstance(value, Mapping):
            names += _names(value, f"{prefix}{key}.")
    return names


def _plain(value: object) -> Any:
    """Return tuples as lists, for YAML."""
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def nearest_name(name: str, names: Sequence[str] | dict[str, Any]) -> str:
    """Return the end of a sentence about an unknown recipe, with the nearest known names."""
    near = difflib.get_close_matches(name, names, n=3)
    hint = f"; near: {', '.join(near)}" if near else ""
    return f"{hint}; `foredrive recipes` lists all"
