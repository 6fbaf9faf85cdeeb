"""Reading pickles from outside without running what they say."""

import importlib
import pickle
from pathlib import Path
from typing import Any

from foredrive.errors import InputError

_ALLOWED = {
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("_codecs", "encode"),
}
"""What arrays and numbers are made of; plain containers need nothing."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # before numpy 2
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which plain data do not need")
        return getattr(importlib.import_module(module), name)


def load_pickle(file: Path) -> Any:
    """Load a pickle that holds nothing but containers, numbers, strings and numpy arrays.

    Raises:
        InputError: if it holds anything else or is damaged.
    """
    try:
        with Path(file).open("rb") as source:
            return _Unpickler(source).load()
    except (pickle.UnpicklingError, OSError, EOFError, ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{file}: cannot read it as a pickle of plain data: {error}") from error
