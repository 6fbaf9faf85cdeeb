"""JSON files from outside."""

import json
from pathlib import Path
from typing import Any

from foredrive.errors import InputError

PICKLES = (".pkl", ".pickle")


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        InputError: it cannot be read, or is a pickle: those could run code and are never opened.
    """
    if path.suffix.lower() in PICKLES:
        raise InputError(f"{path}: pickles are never read, because they can run code; write the same as JSON")
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON that can be read") from error
