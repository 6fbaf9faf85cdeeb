"""Packages that import what they offer when it is asked for: no verb waits for what only others use."""

import importlib
import importlib.util
import sys
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


def defer_imports(package: str, homes: Mapping[str, tuple[str, ...]]) -> None:
    """Let a library's package take its names from its modules when they are asked for.

    The package's own `__init__`, which would import all of its modules, is not run. Nothing changes where
    the package has been imported already.

    Args:
        package: its full name.
        homes: as for `on_demand`; all that its `__init__` offers.
    """
    if package in sys.modules:
        return
    spec = importlib.util.find_spec(package)
    assert spec is not None, f"{package} is not installed"
    module = importlib.util.module_from_spec(spec)
    module.__getattr__ = on_demand(package, homes)  # type: ignore[method-assign]
    sys.modules[package] = module
