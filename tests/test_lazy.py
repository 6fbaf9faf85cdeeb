"""Packages that import on demand offer what they say, and nothing else."""

import gc
import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from foredrive.lazy import importing


@pytest.mark.parametrize("package", ["data", "scene", "runs"])
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


def test_a_deferred_package_is_whole_once_it_is_used() -> None:
    _run(
        "from foredrive.lazy import defer_package; import sys; defer_package('email')\n"
        "import email; assert 'email.message' not in sys.modules and 'email.parser' not in sys.modules\n"
        "import email.charset; assert email.message_from_string('a: b')['a'] == 'b'\n"
        "assert email.__path__ and email.charset.Charset"
    )


def test_no_verb_begins_with_imports_that_it_may_not_need() -> None:
    """A log is opened, and drives are recorded, without the libraries that made py123d slow to import."""
    _run(
        "import sys, foredrive.cli.main, foredrive.data.logs\n"
        "import foredrive.runs.drive.recording, foredrive.runs.drive.suite\n"
        "slow = {'ray', 'jsonschema', 'matplotlib', 'pandas.core'}\n"
        "slow |= {'geopandas.base', 'laspy.lib', 'scipy.stats', 'aiohttp', 'fsspec'}\n"
        "assert not slow & set(sys.modules), slow & set(sys.modules)"
    )


def test_the_garbage_collector_runs_again_after_imports() -> None:
    with importing():
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(KeyError), importing():
        raise KeyError
    assert gc.isenabled()


def _run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _homes(imported: str) -> dict[str, str]:
    code = f"{imported}; import json; print(json.dumps({{n: getattr(p, n).__module__ for n in p.__all__}}))"
    found: dict[str, str] = json.loads(_run(code))
    return found


MODELS = """
import importlib, pkgutil, sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None  # not installed
imported = 0
for root in ("ops", "methods", "geometry", "scene", "sensors", "sets", "heads"):
    package = importlib.import_module(f"foredrive.{root}")
    for module in pkgutil.walk_packages(package.__path__, f"foredrive.{root}."):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            assert error.name == "triton", f"{module.name}: {error}"
        imported += 1
print(imported)
"""


def test_models_ops_and_losses_need_neither_123d_nor_its_tables() -> None:
    absent = "py123d,pyarrow,pandas,geopandas,lancedb,viser,shapely,trimesh,embreex,lightning_fabric,ray"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", MODELS, absent], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 150
