"""Packages that import their modules on first use, so that a command imports only what it needs."""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from typing import Any


def on_demand(package: str, homes: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package (PEP 562) that imports names from its modules.

    Args:
        package: full name of the package.
        homes: names provided by each module of the package.
    """
    home_of = {name: f"{package}.{module}" for module, names in homes.items() for name in names}

    def import_name(name: str) -> Any:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(home_of[name]), name)

    return import_name


def defer_imports(package: str, homes: Mapping[str, tuple[str, ...]]) -> None:
    """Make a library's package import its names from its modules on first use.

    The package's own `__init__`, which would import all modules, is not run. If the package is already
    imported, nothing changes.

    Args:
        package: full name of the package.
        homes: as for `on_demand`. It must contain all names that `__init__` offers.
    """
    if package in sys.modules:
        return
    spec = importlib.util.find_spec(package)
    assert spec is not None, f"{package} is not installed"
    module = importlib.util.module_from_spec(spec)
    module.__getattr__ = on_demand(package, homes)  # type: ignore[method-assign]
    sys.modules[package] = module
