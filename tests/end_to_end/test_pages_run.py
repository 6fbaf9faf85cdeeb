"""README, the first pages and the tutorials run as they are printed, from an empty folder: only smaller."""

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from foredrive.cli.main import main

ROOT = Path(__file__).parents[2]
EXAMPLE = "examples/own_planner.py"
FEW_STEPS = "--set pretrain.schedule.steps=2 finetune.schedule.steps=2"


@dataclass(frozen=True)
class Walk:
    """Pages whose commands run one after another in one folder."""

    pages: tuple[str, ...]
    smaller: Mapping[str, str]
    """Texts to replace, so that all commands together take two minutes."""
    files: tuple[str, ...]
    """Files that have to be there at the end."""
    skipped: str = "-"
    """Matches commands that are left out, such as those that serve a page."""
    section: str = ""
    """Heading from which on commands run."""

    def commands(self) -> list[str]:
        """Return the smaller commands."""
        lines: list[str] = []
        for page in self.pages:
            text = (ROOT / page).read_text()
            for block in re.findall(r"^```bash\n(.*?)^```", text[text.index(self.section) :], re.M | re.S):
                lines += re.findall(r"^foredrive .+?(?= +[#>] |$)", block, re.M)
        kept = [line for line in lines if not re.match(f"foredrive ({self.skipped})", line)]
        return smaller("\n".join(kept), self.smaller).splitlines()


def smaller(text: str, changes: Mapping[str, str]) -> str:
    """Return a text with these changes.

    Raises:
        AssertionError: the text has nothing to change.
    """
    for printed, small in changes.items():
        assert printed in text, printed
        text = text.replace(printed, small)
    return text


README = Walk(
    ("README.md",),
    {
        "--seconds 20 --seed 3": "--seconds 5 --rate 2 --seed 3",
        "--seconds 10 --seed 3": "--seconds 5 --rate 2 --seed 3",
        # The raw log of PandaSet is not here: a drive takes its place
        "convert pandaset path/to/pandaset": "record --town Town02 --seconds 6 --rate 4 --seed 7",
        "data/logs/pandaset_train/002": "data/logs/town_train/Town02_seed7",
        "train nemo_tiny": f"train nemo_tiny {FEW_STEPS}",
        "--only 12 1": "--only 4",
        "--only Town01-3 Town02-1": "--only Town02-1",
        "--cameras pcam_f0": "--cameras pcam_f0 --image-size 36 64 --set representation.schedule.steps=4",
        " --remove 40": "",
        "--virtual-egos 40": "--virtual-egos 3",
        "--budget 30": "--budget 2",
    },
    ("runs/002/by_sight/summary.json", "runs/improved/report.html", "shifted.mp4", "trucks.json", "hits.png"),
    section="## Use it",
)
FIRST_HOUR = Walk(
    ("docs/first-hour.md",),
    {
        "--seconds 20 --seed 3": "--seconds 8 --rate 4 --seed 3",
        "--only 0 1 2": "--only 4",
        "--image-size 96 160": "--image-size 36 64 --set representation.schedule.steps=4",
    },
    ("runs/first/report.html", "runs/expert/report.html", "shifted.webp", "hits.png"),
    "demo|view|drive --in",
)
HOW_TO = Walk(
    ("docs/how-to/train.md", "docs/how-to/view.md"),
    {
        "--town Town01 Town03 --seeds 4 --seconds 60": "--town Town02 --seeds 1 --seconds 5 --rate 2",
        "--town Town05 --seeds 2 --seconds 30": "--town Town05 --seeds 3..3 --seconds 5 --rate 2",
        "train nemo_tiny --logs": f"train nemo_tiny {FEW_STEPS} --logs",
        "--set finetune.schedule.lr=5e-4": f"{FEW_STEPS} finetune.schedule.lr=5e-4",
        "--tasks detection --probe": "--tasks detection --probe --set tasks.schedule.steps=2",
    },
    ("runs/heads/tasks/model.safetensors", "at_4s.png", "futures.mp4", "runs/town/export/model.onnx"),
    "evaluate runs/(heads|town --in)|view (?!.*--save)",
)
TUTORIALS: Mapping[str, Mapping[str, str]] = {
    "failures": {
        "--seeds 2 --conditions clear night": "--seeds 4..4 --conditions night",
        "--seconds 8": "--seconds 6",
    },
    "own_log": {},
    "protocols": {"--seconds 12": "--seconds 6", "clips[6]": "clips[0]"},
    "reconstruct": {
        "--rate 5": "--rate 4",
        "--image-size 96 160": "--image-size 36 64",
        "steps=200": "steps=4",
    },
    "world_model": {
        "--seconds 40": "--seconds 8",
        "steps=150": "steps=12",
        "warmup_steps=15": "warmup_steps=2",
        "steps=30": "steps=2",
    },
}
"""Texts of each tutorial to replace, as in a walk."""


@pytest.mark.parametrize("walk", [README, FIRST_HOUR, HOW_TO], ids=["README", "first-hour", "how-to"])
def test_the_commands_of_a_page_run(
    walk: Walk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / EXAMPLE).parent.mkdir()
    (tmp_path / EXAMPLE).write_text((ROOT / EXAMPLE).read_text())
    commands = walk.commands()
    assert len(commands) >= 8
    for command in commands:
        run_command(command, capsys)
    for file in walk.files:
        assert (tmp_path / file).stat().st_size > 0


def run_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a command as the shell does."""
    code = main(shlex.split(command)[1:])
    assert code == 0, f"{command}: {capsys.readouterr().err}"


@pytest.mark.parametrize(
    "tutorial", sorted((ROOT / "docs" / "tutorials").glob("*.py")), ids=lambda file: file.stem
)
def test_a_tutorial_runs(
    tutorial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {}
    for cell in re.split(r"^# %%", smaller(tutorial.read_text(), TUTORIALS[tutorial.stem]), flags=re.M):
        kind, _, source = cell.partition("\n")
        if "bash" in kind:
            for command in re.findall(r"^# (foredrive .+)", source, re.M):
                run_command(command, capsys)
        elif "markdown" not in kind:
            exec(compile(source, tutorial, "exec"), names)
