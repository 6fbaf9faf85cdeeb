"""Packages that import on demand offer what they say, and nothing else."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("package", ["data", "training", "evaluation", "recipes", "runs"])
def test_what_a_package_offers_is_there(package: str) -> None:
    module = importlib.import_module(f"foredrive.{package}")
    assert all(getattr(module, name) is not None for name in module.__all__)
    modules = {path.stem for path in Path(str(module.__file__)).parent.iterdir()}
    assert not modules & set(module.__all__)  # such a name would become the module once that is imported
    with pytest.raises(AttributeError, match=f"foredrive.{package}' has no attribute 'no_such_thing'"):
        _ = module.no_such_thing


def test_what_a_deferred_package_offers_is_what_its_own_init_offers() -> None:
    """Of py123d's executors, whose `__init__` imports Ray; each way in a process of its own."""
    package = "py123d.common.execution"
    own = _homes(f"import {package} as p")
    deferred = f"import foredrive.data, sys, {package} as p; assert 'ray' not in sys.modules"
    assert own["RayExecutor"] == f"{package}.ray_executor"
    assert _homes(f"{deferred}; p.__all__ = {list(own)}") == own


def _homes(imported: str) -> dict[str, str]:
    code = f"{imported}; import json; print(json.dumps({{n: getattr(p, n).__module__ for n in p.__all__}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    found: dict[str, str] = json.loads(done.stdout)
    return found
