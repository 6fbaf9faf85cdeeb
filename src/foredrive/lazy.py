"""Packages that import what they offer when it is asked for: no verb waits for what only others use."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def on_demand(package: str, homes: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """The `__getattr__` of a package (PEP 562) that takes names from its modules.

    Args:
        package: its full name.
        homes: by module of the package, the names that it provides.
    """
    home_of = {name: f"{package}.{module}" for module, names in homes.items() for name in names}

    def import_name(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(home_of[name]), name)

    return import_name
