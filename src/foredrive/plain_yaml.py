"""Reading of untrusted YAML: plain values only, and no more of them than the text holds.

A file of some hundred bytes can stand for gigabytes: an alias repeats a value, and aliases of aliases repeat
it exponentially often ("billion laughs"). PyYAML shares repeated values, but whatever copies, validates or
prints them does not.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from foredrive.errors import InputError

MAX_BYTES = 2**20
"""Size of the largest file. The recipes of this package have less than 10 kB."""
MAX_VALUES = 100_000
"""Largest number of values, each repeated as often as aliases repeat it."""
MAX_SCALAR = 10_000
"""Number of characters of the longest scalar. Python converts long numbers in quadratic time."""


def read_yaml(path: Path, what: str = "YAML", *, as_text: bool = False) -> Any:
    """Read a YAML file as plain values.

    Args:
        path: the file.
        what: what the file should be, for messages.
        as_text: whether all scalars are strings as written, so that `0101` and `1e05` remain names.

    Raises:
        InputError: the file cannot be read, is no YAML, is too large, repeats a key, or its aliases repeat
            too much.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: not {what}: longer than {MAX_BYTES:,} bytes")
    try:
        return parse_yaml(content.decode(), as_text=as_text)
    except (InputError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not {what}: {error}") from error


def parse_yaml(text: str, *, as_text: bool = False) -> Any:
    """Return the plain values of a YAML text.

    Raises:
        InputError: as `read_yaml`.
    """
    try:
        loader: Any = (yaml.BaseLoader if as_text else yaml.SafeLoader)(text)
        # Nodes are built, not values: an alias is its target's node, so they are no larger than the text
        root = loader.get_single_node()
        if root is None:
            return None
        _count_values(root, {})
        return loader.construct_document(root)
    except InputError:
        raise
    except RecursionError:
        raise InputError("nested too deeply") from None
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # The date 2001-13-45 is a ValueError
        raise InputError((str(error).splitlines() or [type(error).__name__])[0]) from error


def _count_values(node: yaml.Node, counts: dict[int, int]) -> int:
    """Return the number of values of a node when all aliases are replaced by their values.

    Args:
        node: the node.
        counts: the results for the nodes seen before, by `id`; 0 marks a node that is being counted.

    Raises:
        InputError: a node contains itself, has a key twice or too long a scalar, or there are too many
            values.
    """
    if id(node) in counts:
        if counts[id(node)] == 0:
            raise InputError(f"line {node.start_mark.line + 1}: a value contains itself")
        return counts[id(node)]
    # A node is counted once; an alias adds the stored count, so the time is linear in the text
    counts[id(node)], children = 0, list[yaml.Node]()
    if isinstance(node, yaml.MappingNode):
        _check_keys(node)
        children = [part for entry in node.value for part in entry]
    elif isinstance(node, yaml.SequenceNode):
        children = node.value
    elif len(node.value) > MAX_SCALAR:
        raise InputError(f"line {node.start_mark.line + 1}: a value of more than {MAX_SCALAR:,} characters")
    total = 1 + sum(_count_values(child, counts) for child in children)
    if total > MAX_VALUES:
        raise InputError(f"more than {MAX_VALUES:,} values, aliases replaced by what they name")
    counts[id(node)] = total
    return total


def _check_keys(node: yaml.MappingNode) -> None:
    """Refuse a key that is given twice. PyYAML would take the last one."""
    keys = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
    for key, times in keys.items():
        if times > 1:
            raise InputError(f"line {node.start_mark.line + 1}: the key {key[:100]!r} is given twice")
