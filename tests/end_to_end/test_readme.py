"""The commands of README run as they are printed, from an empty folder: only smaller."""

import re
import shlex
from pathlib import Path

import pytest

from foredrive.cli.main import main

ROOT = Path(__file__).parents[2]
SMALLER = {
    "--seconds 20 --seed 3": "--seconds 5 --rate 2 --seed 3",
    "--seconds 10 --seed 3": "--seconds 5 --rate 2 --seed 3",
    # The raw log of PandaSet is not here: a drive takes its place
    "convert pandaset path/to/pandaset": "record --town Town02 --seconds 6 --rate 4 --seed 7",
    "data/logs/pandaset_train/002": "data/logs/town_train/Town02_seed7",
    "train nemo_tiny": "train nemo_tiny --set pretrain.schedule.steps=2 finetune.schedule.steps=2",
    "--only 12 1": "--only 4",
    "--only Town01-3 Town02-1": "--only Town02-1",
    "--cameras pcam_f0": "--cameras pcam_f0 --image-size 36 64 --set representation.schedule.steps=4",
    " --remove 40": "",
    "--virtual-egos 40": "--virtual-egos 3",
    "--budget 30": "--budget 2",
}
"""What is replaced, so that all commands together take two minutes."""
EXAMPLES = "examples/own_planner.py"


def smaller_commands() -> list[str]:
    (block,) = re.findall(
        r"^## Use it\n.*?^```bash\n(.*?)^```", (ROOT / "README.md").read_text(), re.M | re.S
    )
    lines = [line.partition(" #")[0] for line in block.splitlines() if line.startswith("foredrive ")]
    text = "\n".join(lines)
    for printed, small in SMALLER.items():
        assert printed in text, printed
        text = text.replace(printed, small)
    return text.splitlines()


def test_every_command_of_readme_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / EXAMPLES).parent.mkdir()
    (tmp_path / EXAMPLES).write_text((ROOT / EXAMPLES).read_text())
    commands = smaller_commands()
    assert len(commands) >= 17
    for command in commands:
        code = main(shlex.split(command)[1:])
        assert code == 0, f"{command}: {capsys.readouterr().err}"
    for made in ("runs/town/finetune", "runs/002/by_sight/drives", "runs/improved/report.html"):
        assert (tmp_path / made).exists()
    for file in ("shifted.mp4", "trucks.json", "hits.png"):
        assert (tmp_path / file).stat().st_size > 0
