"""Configurations as plain values: read from YAML, validated, changed by settings, written."""

import ast
import difflib
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.plain_yaml import parse_yaml, read_yaml

LINE = 110
"""Characters of a line of an explained recipe."""


def save_recipe(recipe: Any, path: Path) -> None:
    """Write a recipe of any kind, a dataclass of plain values, as YAML."""
    with atomic_path(path) as temporary:
        temporary.write_text(recipe_yaml(recipe))


def recipe_yaml(recipe: Any) -> str:
    """Return a recipe of any kind as YAML."""
    plain = _plain(asdict(recipe))
    return yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100)


def explained_yaml(recipe: Any) -> str:
    """Return the YAML of a recipe of any kind with an entry a line and comments that say what each means.

    The comments are the first sentences of the fields' docstrings, see `field_helps`.
    """
    return "\n".join(_explained(recipe, _plain(asdict(recipe)), "")) + "\n"


def _explained(recipe: Any, values: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Yield the lines of a recipe or a part of it. `values` are its plain values."""
    helps = field_helps(recipe.__class__)  # mypy takes no type(…) for hashable
    for key, value in values.items():
        part = getattr(recipe, key)
        nested = is_dataclass(part) and bool(value)
        lines = [f"{key}:"] if nested else _entry(key, value)
        about = helps.get(key) or _summary(part)
        behind = f"{indent}{lines[0]}  # {about}"
        if about and len(lines) == 1 and len(behind) <= LINE:
            yield behind
        else:
            comment = f"{indent}# "
            yield from textwrap.wrap(
                about, LINE, initial_indent=comment, subsequent_indent=comment, break_on_hyphens=False
            )
            yield from (indent + line if line else line for line in lines)
        if nested:
            yield from _explained(part, value, indent + "  ")


def _entry(key: str, value: Any) -> list[str]:
    """Return the lines of an entry that is no dataclass. Lists of numbers or words take one."""
    flow = None if isinstance(value, (list, dict)) else False
    text = yaml.safe_dump(
        {key: value}, sort_keys=False, allow_unicode=True, default_flow_style=flow, width=100
    )
    return text.rstrip("\n").split("\n")


@cache
def field_helps(kind: type) -> dict[str, str]:
    """Return the first sentence about each field of a dataclass that has one.

    It is in the docstring below the field, or under "Args:" in the docstring of the class or of a base.
    """
    helps: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_dataclass(base):
            continue
        section = re.search(r"^Args:\n((?: .*\n?|\n)+)", inspect.cleandoc(base.__doc__ or ""), re.MULTILINE)
        listed = re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", section[1] if section else "", re.MULTILINE)
        helps |= {name: _first_sentence(text) for name, text in listed}
        for entry, below in pairwise(_statements(base)):
            match entry, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    helps[name] = _first_sentence(text)
    return helps


def _statements(kind: type) -> list[ast.stmt]:
    """Return the statements in the body of a class."""
    try:
        parsed = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    except (OSError, TypeError):  # a frozen program has no sources
        return []
    assert isinstance(parsed, ast.ClassDef)
    return parsed.body


def _first_sentence(text: str) -> str:
    """Return the first sentence of a docstring on one line."""
    return re.split(r"(?<=[.!?])(?<!\beq\.) (?=[A-Z0-9`\"])", " ".join(text.split()))[0]


def _summary(part: Any) -> str:
    """Return the first line of the docstring of a part of a recipe. Empty: it is a plain value."""
    doc = type(part).__doc__ if is_dataclass(part) else None
    return "" if doc is None or doc.startswith(f"{type(part).__name__}(") else doc.strip().split("\n")[0]


def is_recipe_file(name: str) -> bool:
    """Return whether the name of a recipe is that of a YAML file."""
    return name.endswith((".yaml", ".yml"))


def read_values(path: Path) -> Any:
    """Read YAML.

    Raises:
        InputError: the file cannot be read or is not YAML.
    """
    return read_yaml(path, "a recipe")


def validated(kind: Any, written: Any, source: str, what: str = "recipe") -> Any:
    """Return plain values as a dataclass, generic or not.

    Args:
        kind: the dataclass.
        written: plain values.
        source: where they are from, for messages.
        what: what they should be, for messages.

    Raises:
        InputError: an entry is wrong, missing or unknown. The message names it.
    """
    try:
        return TypeAdapter(kind).validate_python(written, extra="forbid")
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{source}: not a {what}: {f'{where}: ' if where else ''}{first['msg']}") from error


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
