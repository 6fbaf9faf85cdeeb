"""What a user sees when a verb cannot go on: one line and an exit code."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch._utils import ExceptionWrapper

import foredrive
from foredrive.cli import main as program
from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.files import atomic_path

FULL = Path("/dev/full")  # every write to it fails with ENOSPC
needs_full_device = pytest.mark.skipif(not FULL.is_char_device(), reason="this system has no /dev/full")


@pytest.fixture
def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[[Callable[[], None]], tuple[int, str]]:
    """Run a function as the only verb; exit code and what stood on stderr."""

    def run_verb(verb: Callable[[], None]) -> tuple[int, str]:
        monkeypatch.setattr(program, "VERBS", {"try": verb, "other": lambda: None})
        code = main(["try"])
        return code, capsys.readouterr().err

    return run_verb


def test_a_verb_that_ends_well_is_silent(run: Callable) -> None:
    assert run(lambda: None) == (0, "")


def test_a_reader_that_has_stopped_ends_the_verb(run: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w", buffering=1) as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        assert run(lambda: print("a line")) == (141, "")


def test_bad_input_is_one_line_and_2(run: Callable) -> None:
    def verb() -> None:
        raise InputError("runs/a: not a run folder\n  (no config.yaml)")

    assert run(verb) == (2, "foredrive: runs/a: not a run folder (no config.yaml)\n")


def test_bad_input_met_by_a_worker_process_is_the_same_line(run: Callable) -> None:
    def verb() -> None:
        try:
            raise InputError("log/camera.arrow: cannot read frame 3")
        except InputError:  # how torch's DataLoader carries an error over from a worker
            ExceptionWrapper(where="in DataLoader worker process 0").reraise()

    assert run(verb) == (2, "foredrive: log/camera.arrow: cannot read frame 3\n")


def test_an_interrupt_within_a_destructor_is_not_lost(run: Callable) -> None:
    class Interrupted:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def verb() -> None:
        thing = Interrupted()
        del thing
        for _ in range(1000):
            time.sleep(0.001)

    assert run(verb) == (130, "foredrive: interrupted\n")


def test_an_interrupt_is_one_line_and_130(run: Callable) -> None:
    def verb() -> None:
        raise KeyboardInterrupt

    assert run(verb) == (130, "foredrive: interrupted\n")


@needs_full_device
def test_a_full_disk_is_one_line_that_names_the_file(run: Callable, tmp_path: Path) -> None:
    def verb() -> None:
        with atomic_path(tmp_path / "summary.json") as scratch:
            scratch.symlink_to(FULL)
            scratch.write_text("{}")

    code, err = run(verb)
    assert code == 2
    assert err == f"foredrive: {tmp_path / 'summary.json'}: no space left on the disk\n"
    assert list(tmp_path.iterdir()) == []


@needs_full_device
def test_a_full_disk_behind_another_error_is_found(run: Callable, tmp_path: Path) -> None:
    def verb() -> None:
        with atomic_path(tmp_path / "grid.npy") as scratch:
            try:
                with FULL.open("wb") as file:
                    np.save(file, np.zeros(100_000))
            except OSError as error:
                raise RuntimeError(f"could not save {scratch}") from error

    assert run(verb) == (2, f"foredrive: {tmp_path / 'grid.npy'}: no space left on the disk\n")


def test_a_library_that_keeps_only_the_text_is_understood(run: Callable, tmp_path: Path) -> None:
    def verb() -> None:
        with atomic_path(tmp_path / "model.safetensors"):
            raise RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)")

    assert run(verb) == (2, f"foredrive: {tmp_path / 'model.safetensors'}: no space left on the disk\n")


def test_a_folder_that_must_not_be_written_to_is_one_line(run: Callable, tmp_path: Path) -> None:
    def verb() -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / "out"))

    assert run(verb) == (2, f"foredrive: {tmp_path / 'out'}: permission denied\n")


def test_mistakes_in_the_program_keep_their_traceback(run: Callable) -> None:
    def verb() -> None:
        raise ZeroDivisionError("a bug")

    with pytest.raises(ZeroDivisionError, match="a bug"):
        run(verb)


@pytest.mark.parametrize("asked", ["torch.empty(10**14)", "bytearray(2**62)"])
def test_memory_that_there_is_not_is_one_line(run: Callable, asked: str) -> None:
    code, err = run(lambda: eval(asked, {"torch": torch}))
    assert code == 2
    assert err.startswith("foredrive: not enough memory")
    assert err.count("\n") == 1
    assert "372,529.0 GiB" in err or asked.startswith("bytearray")


def test_a_missing_file_is_a_mistake_unless_a_verb_says_otherwise(run: Callable) -> None:
    with pytest.raises(FileNotFoundError):
        run(lambda: Path("/nowhere/at/all").read_text())


@pytest.mark.parametrize("args", [["vew"], ["view"], ["train", "nemo_tiny"]])
def test_what_the_command_line_gets_wrong_ends_in_2(
    args: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(args)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("spelling", ["--set", "--image_size", "--rate=2"])
def test_a_flag_given_twice_is_refused(spelling: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The parser alone would drop the first without a word."""
    flag = spelling.partition("=")[0].replace("_", "-")
    assert main(["record", spelling, "1", "--town", "Town01", flag, "2"]) == 2
    assert capsys.readouterr().err.startswith(f"foredrive: {flag} is given twice; several values")


def test_several_values_follow_one_flag(
    log: LogPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["finetune.schedule.lr=1e-3", "finetune.schedule.stepz=4"]
    out = ["--out", str(tmp_path / "run")]
    assert main(["train", "nemo_tiny", "--logs", str(log.folder), *out, "--set", *settings]) == 2
    assert "stepz" in capsys.readouterr().err


def test_an_unknown_verb_is_told_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["vew"])
    assert "view" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["view", "{tmp}/none", "--save", "{tmp}/x.png"], "{tmp}/none: no such folder"),
        (["view", "{tmp}", "--save", "{tmp}/x.png"], "{tmp}: no 123D log here"),
        (["train", "nemo_tiny", "--logs", "{tmp}/none", "--out", "{tmp}/run"], "{tmp}/none: no such folder"),
        (["record", "--town", "Town9", "--out", "{tmp}/out"], "one of Town01, Town02, Town03"),
        (["evaluate", "{tmp}"], "{tmp}: not a run folder"),
        (["imagine", "{tmp}", "{tmp}", "--out", "{tmp}/x.avi"], "{tmp}/x.avi: videos end on .mp4"),
        (["convert", "pandaset", "{tmp}/none", "--out", "{tmp}/out"], "{tmp}/none: no such folder"),
        (
            ["convert", "kitti-object", "{tmp}", "--out", "{file}"],
            "--out {file}: this is a file",
        ),
        (["reconstruct", "{tmp}", "--out", "{file}"], "--out {file}: this is a file"),
        (["convert", "lyft", "{tmp}", "--out", "{tmp}/out"], "there are: pandaset, av2, nuscenes"),
    ],
)
def test_each_verb_names_what_it_cannot_use(
    args: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = Path(__file__)
    assert main([a.format(tmp=tmp_path, file=file) for a in args]) == 2
    err = capsys.readouterr().err
    assert err.startswith("foredrive: ")
    assert err.count("\n") == 1
    assert said.format(tmp=tmp_path, file=file) in err
    assert list(tmp_path.iterdir()) == []  # nothing half-written


@pytest.mark.parametrize(
    ("line", "said"),
    [
        *((line, "this name is too long") for line in (
            "view {long}", "train nemo_tiny --logs {long} --out {tmp}/run", "evaluate {long}",
            "record --town Town02 --out {long}", "score {long} --truth {long}", "compare {long}",
            "convert pandaset {long} --out {tmp}/out", "drive --agent {long} --out {tmp}/out",
            "search rain --index {long}", "reconstruct {long} --out {tmp}/run",
        )),
        ("train nemo_tiny --logs {loop} --out {tmp}/run", "{loop}: no such folder"),
        ("record --town Town02 --out {loop}", "its symbolic links lead in a circle"),
        ("score {log} --truth {log} --out {loop}", "{loop}: a symbolic link that leads nowhere"),
    ],
)  # fmt: skip
def test_names_that_lead_nowhere_are_one_line(
    line: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loop, other = tmp_path / "loop", tmp_path / "other"
    loop.symlink_to(other)
    other.symlink_to(loop)
    (tmp_path / "log").mkdir()
    places = {"long": tmp_path / ("a" * 300), "loop": loop, "tmp": tmp_path, "log": tmp_path / "log"}
    assert main(line.format(**places).split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("foredrive: ")
    assert err.endswith(f"{said.format(**places)}\n")
    assert err.count("\n") == 1


def test_pictures_need_no_home(log: LogPath, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "foredrive", "view", log.folder, "--save", tmp_path / "log.png"]
    done = subprocess.run(
        command, env=os.environ | {"HOME": "/proc/nowhere"}, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""


RECORD, RENDER = "record --town Town01 --out {tmp}/out", "render {tmp} --out {tmp}/x.webp"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (f"{RECORD} --image-size 0 0", "--image-size must be 1 to 16384 px, got 0 0"),
        (f"{RECORD} --image-size -4 256", "--image-size must be 1 to 16384 px, got -4 256"),
        (f"{RECORD} --seed -1", "--seed must be a number of 0 or more, got -1"),
        (f"{RECORD} --seconds nan", "--seconds must be a number above 0, got nan"),
        (f"{RECORD} --workers -2", "--workers must be a number of 0 or more, got -2"),
        (
            f"{RECORD} --conditions none rain",
            "--conditions none cannot be combined with other names, got none rain",
        ),
        (f"{RECORD} --conditions hail", "unknown conditions hail; the conditions are clear, morning,"),
        ("reconstruct {tmp} --out {tmp}/out --image-size 0 0", "--image-size must be 1 to 16384 px, got 0 0"),
        ("view {tmp} --reach inf", "--reach must be a number above 0, got inf"),
        ("view {tmp} --reach -5", "--reach must be a number above 0, got -5"),
        ("view {tmp} --t nan", "--t must be a finite number, got nan"),
        (f"{RENDER} --shift-left nan", "--shift-left must be a number from -100 to 100, got nan"),
        (f"{RENDER} --shift-left 1e30", "--shift-left must be a number from -100 to 100, got 1e+30"),
        (f"{RENDER} --rate-hz 0", "--rate-hz must be a number above 0, got 0"),
        ("search rain --before -5 --after -9", "--before must be a number of 0 or more, got -5"),
        ("search rain --before 0 --after 0", "--before and --after are 0: such a clip is empty"),
        ("drive --agent stop --out {tmp}/out --period 0", "--period must be a number above 0, got 0"),
        (
            "drive --agent stop --out {tmp}/out --image-size 0 9",
            "--image-size must be 1 to 16384 px, got 0 9",
        ),
    ],
)
def test_numbers_that_there_cannot_be_are_refused(
    line: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.format(tmp=tmp_path).split()) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"foredrive: {said}")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"foredrive {foredrive.__version__}\n"


def test_verbs_of_search_have_one_spelling(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["search-index", "logs"])
    assert ended.value.code == 2
    assert "Unrecognized options: search-index" in capsys.readouterr().err


def test_an_unknown_recipe_is_told_the_nearest_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sync.arrow").touch()  # looks like a log
    assert main(["train", "nemo_bass", "--logs", str(tmp_path), "--out", str(tmp_path / "run")]) == 2
    assert "no recipe 'nemo_bass'; near: nemo_base" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


HEAVY = {
    "torch",
    "ray",
    "py123d.datatypes",
    "numba",
    "scipy",
    "matplotlib",
    "torchmetrics",
    "lightning_fabric",
    "transformers",
}
"""What takes long to import."""
LOGS = {"torch", "py123d.datatypes", "numba", "scipy"}  # py123d.api would bring Ray along


def heavy_after(*steps: str) -> list[set[str]]:
    """What of `HEAVY` a new process has imported after each of some statements."""
    told = f"\nprint(*({HEAVY} & set(sys.modules)), file=sys.stderr)\n"
    code = "import sys\n" + told.join([*steps, ""])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return [set(line.split()) for line in done.stderr.splitlines() if not line.startswith("foredrive: ")]


def test_help_waits_for_nothing_heavy() -> None:
    commands = [["--help"], ["--version"], *([*verb.split(), "--help"] for verb in program.VERBS)]
    helped = "from foredrive.cli.main import main\n" + "\n".join(
        f"try:\n    main({command})\nexcept SystemExit:\n    pass" for command in commands
    )
    assert heavy_after(helped) == [set()]


def test_verbs_wait_for_nothing_they_do_not_use() -> None:
    bench, convert, record, view, recipes, evaluate = heavy_after(
        "import benchmarks.common.benchmark",
        "import foredrive.data.formats.convert",
        "import foredrive.runs.drive.recording",
        "import foredrive.data, foredrive.view.log_sheet, foredrive.view.log_frames",
        "import foredrive.runs.recipes.known",
        "import foredrive.runs.evaluate.run, foredrive.view.run_report",
    )
    assert bench == {"torch"}
    assert convert <= LOGS
    assert record <= LOGS
    assert view <= LOGS | {"matplotlib"}
    assert not {"ray", "transformers", "lightning_fabric"} & recipes
    assert not {"ray", "transformers", "lightning_fabric"} & evaluate


@pytest.mark.parametrize(
    "line",
    [
        "view {tmp}/none",
        "train nemo_tiny --logs {tmp}/none --out {tmp}/run",
        "evaluate {tmp}/none",
        "reconstruct {tmp}/none --out {tmp}/run",
        "drive --agent stop --in {tmp}/none --out {tmp}/run",
        "search rain --index {tmp}/none",
        "search index {tmp}/none",
        "convert pandaset {tmp}/none --out {tmp}/out",
        "record --town Town9 --out {tmp}/out",
        "score {tmp}/none --truth {tmp}/none",
    ],
)
def test_a_wrong_argument_is_told_before_anything_heavy_is_imported(line: str, tmp_path: Path) -> None:
    args = line.format(tmp=tmp_path).split()
    assert heavy_after(f"from foredrive.cli.main import main\nassert main({args}) == 2")[-1] == set()


def test_it_runs_as_a_module_and_passes_its_exit_code_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "foredrive", "view", str(tmp_path), "--save", str(tmp_path / "x.png")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"foredrive: {tmp_path}: no 123D log here (a log is a folder with a sync.arrow)\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_real_interrupt_reaches_the_verb(number: signal.Signals) -> None:
    """Ctrl-C, as the terminal sends it, or SIGTERM to a process in the middle of a verb."""
    code = (
        "import sys, time\n"
        "from foredrive.cli import main as program\n"
        "def wait():\n    print('waiting', flush=True)\n    time.sleep(60)\n"
        "program.VERBS = {'wait': wait, 'other': wait}\n"
        "sys.exit(program.main(['wait']))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "waiting\n"
    time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err == "foredrive: interrupted\n"


def test_a_reader_that_leaves_early_is_no_error() -> None:
    command = f"{sys.executable} -m foredrive view --help | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: foredrive view")
    assert done.stderr == ""
