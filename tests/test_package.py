"""The wheel holds the package and nothing else, and is enough to work with."""

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MAX_BYTES = 32_000_000
pytestmark = pytest.mark.slow


def done(*command: object, cwd: Path) -> str:
    """Run a command without the checkout on its path; return what it prints."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    run = subprocess.run([*map(str, command)], cwd=cwd, env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]
    return run.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of `make dist`, or one that is built from the files that git knows."""
    if "FOREDRIVE_WHEEL" in os.environ:
        return Path(os.environ["FOREDRIVE_WHEEL"]).absolute()
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    done("git", "-C", ROOT, "checkout-index", "--all", f"--prefix={source}/", cwd=source)
    done(
        sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", out, ".", cwd=source
    )
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment with the wheel, which reads its dependencies from this one."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    done(
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--no-deps",
        "--no-index",
        wheel,
        cwd=folder,
    )
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = Path(done(python, "-c", where, cwd=folder).strip())
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return python


def test_the_wheel_holds_the_package_and_nothing_else(wheel: Path) -> None:
    known = done("git", "-C", ROOT, "ls-files", "src", cwd=ROOT).split()
    known = [name for name in known if Path(name).name != "CHOICES.md"]  # pages, for readers of the sources
    with zipfile.ZipFile(wheel) as opened:
        names = {name for name in opened.namelist() if ".dist-info/" not in name}
    assert names == {name.removeprefix("src/") for name in known}
    assert wheel.stat().st_size < MAX_BYTES


def test_the_program_of_the_wheel_helps_and_lists(python: Path, tmp_path: Path) -> None:
    program = python.with_name("foredrive")
    place = done(python, "-c", "import foredrive; print(foredrive.__file__)", cwd=tmp_path)
    assert place.startswith(str(python.parents[1]))
    assert "evaluate" in done(program, "--help", cwd=tmp_path)
    assert "nemo_tiny" in done(program, "recipes", cwd=tmp_path)
    assert "embedded:nemo_town" in done(program, "models", cwd=tmp_path)
    assert "--logs" in done(program, "evaluate", "embedded:nemo_town", "--help", cwd=tmp_path)


def test_the_demo_runs_from_the_wheel_alone(python: Path, tmp_path: Path) -> None:
    done(python.with_name("foredrive"), "demo", "--quick", "--out", "demo", cwd=tmp_path)
    report = (tmp_path / "demo" / "report.html").read_text()
    # Films: a drive, two that meet the car in the way, and those before and after the round, if there is one
    assert report.count("data:image/webp") in (4, 5)
    assert "This step failed" not in report
