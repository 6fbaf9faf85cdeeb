"""Checks of the package's signatures while tests run: types by beartype, and shapes by jaxtyping.

jaxtyping's own hook takes a third of the tests' time. It compiles every module again, checks shapes where
there are none, and wraps inner functions again at every call. This one leaves inner functions alone.
"""

import functools
import importlib.abc
import importlib.machinery
import inspect
import sys
from collections.abc import Sequence
from types import FunctionType, ModuleType
from typing import Any, get_args

from beartype import beartype
from jaxtyping import AbstractArray, jaxtyped

PACKAGE = "foredrive"
CALLS = 10
"""Shapes are checked in so many calls of a function in a test: loops of simulators call some 10,000 times."""

_left: list[list[int]] = []
"""How many calls of each function are still to be checked in this test."""


def install() -> None:
    """Check the package's modules that are imported from now on."""
    assert PACKAGE not in sys.modules
    sys.meta_path.insert(0, _Finder())


def begin_test() -> None:
    """Count calls anew."""
    for left in _left:
        left[0] = CALLS


def check_all(home: ModuleType | type, module: str) -> None:
    """Replace the functions, methods and data classes' `__init__` that `module` defines by checked ones."""
    for name, what in list(vars(home).items()):
        if getattr(what, "__no_type_check__", False):
            continue
        if isinstance(what, type) and what.__module__ == module and name == what.__name__:
            check_all(what, module)
        elif isinstance(what, FunctionType) and what.__module__ == module:
            setattr(home, name, _checked(what))
        elif isinstance(home, type) and isinstance(what, staticmethod | classmethod):
            if isinstance(what.__func__, FunctionType) and what.__func__.__module__ == module:
                setattr(home, name, type(what)(_checked(what.__func__)))
        elif isinstance(home, type) and isinstance(what, property) and isinstance(what.fget, FunctionType):
            setattr(home, name, what.getter(_checked(what.fget)))


def _checked(function: FunctionType) -> Any:
    original = inspect.unwrap(function)
    if original is not function and inspect.isgeneratorfunction(original):
        return function  # a context manager, which is no iterator as its annotation says
    has_shapes = any(map(_has_shapes, function.__annotations__.values()))
    return _with_shapes(function) if has_shapes else beartype(function)


def _with_shapes(function: FunctionType) -> Any:
    checked, left = jaxtyped(function, typechecker=beartype), [CALLS]
    _left.append(left)

    @functools.wraps(function)
    def counted(*args: Any, **kwargs: Any) -> Any:
        if not left[0]:
            return function(*args, **kwargs)
        left[0] -= 1
        return checked(*args, **kwargs)

    return counted


def _has_shapes(hint: Any) -> bool:
    if isinstance(hint, str):
        return True  # known later
    is_array = isinstance(hint, type) and issubclass(hint, AbstractArray)
    return is_array or any(map(_has_shapes, get_args(hint)))


class _Loader(importlib.machinery.SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        check_all(module, module.__name__)


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name.partition(".")[0] != PACKAGE:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec
