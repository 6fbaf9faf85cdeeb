"""Packages that import their modules on first use, so that a command imports only the modules it needs."""

import contextlib
import gc
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
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
    imported, or the library is not installed, nothing changes.

    Args:
        package: full name of the package.
        homes: as for `on_demand`. It must contain all names that `__init__` offers.
    """
    if package in sys.modules or importlib.util.find_spec(package.partition(".")[0]) is None:
        return
    spec = importlib.util.find_spec(package)
    assert spec is not None, f"{package} is not installed"
    module = importlib.util.module_from_spec(spec)
    # The module is registered without being executed: its `__init__` does not run
    module.__getattr__ = on_demand(package, homes)  # type: ignore[method-assign]
    sys.modules[package] = module


def defer_package(package: str) -> None:
    """Make `import package` cheap: its `__init__` runs when the first attribute or module of it is used.

    If the package is already imported, or not installed, nothing changes. `from package import name` uses it
    at once.
    """
    if package in sys.modules:
        return
    spec = importlib.util.find_spec(package)
    if spec is None:
        return
    assert spec.loader is not None
    loader = spec.loader
    module = importlib.util.module_from_spec(spec)
    # An import of `package.module` reads `package.__path__`. Without the entry this, too, runs `__init__`
    path = vars(module).pop("__path__")

    def run_init(name: str) -> Any:
        # Restore the ordinary state first: `__init__` itself reads attributes and imports modules
        del module.__getattr__
        module.__path__ = path
        loader.exec_module(module)
        return getattr(module, name)

    module.__getattr__ = run_init  # type: ignore[method-assign]
    sys.modules[package] = module


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Pause the garbage collector during imports. It would visit each of their objects several times."""
    gc.disable()
    try:
        yield
    finally:
        # The objects of modules stay until the end, so later collections skip them
        gc.freeze()
        gc.enable()
