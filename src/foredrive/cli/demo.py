"""`foredrive demo`."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from foredrive.data import LogPath
    from foredrive.recipes import Recipe

RECIPE = "nemo_tiny"
TRAIN_DRIVES, TEST_DRIVE = (("Town01", 1), ("Town03", 2)), ("Town05", 3)
RATE_HZ = 4.0


@dataclass(frozen=True)
class Size:
    """How much a demo records and trains."""

    train_seconds: float
    """Of each training town."""
    test_seconds: float
    steps: tuple[int, int] | None = None
    """Of pre-training and fine-tuning; None leaves them to the recipe."""
    examples: int = 4


FULL = Size(train_seconds=90.0, test_seconds=30.0)
QUICK = Size(train_seconds=6.0, test_seconds=5.0, steps=(4, 2), examples=1)


def demo(out: Path = Path("runs/demo"), quick: bool = False) -> None:
    """Go once around the loop: record towns, train NeMo on them, judge it in a town it has not seen.

    Args:
        out: Folder for logs, run and report. What an interrupted demo has finished is not done again.
        quick: Hardly any data or training: shows that everything works, in about a minute.
    """
    from rich.console import Console

    from foredrive.evaluation import print_summary
    from foredrive.recipes import evaluate_run, find_recipe, inspect_run, train_run
    from foredrive.view.hero import write_hero
    from foredrive.view.report import write_report
    from foredrive.view.run_report import inspection_panel, report_on_run

    started = time.perf_counter()
    size, folder = (QUICK, out / "quick") if quick else (FULL, out)
    recipe = _sized(find_recipe(RECIPE), size)
    towns = ", ".join(town for town, _ in TRAIN_DRIVES)
    print(f"1/4  recording {towns} to train on and {TEST_DRIVE[0]} to test on")
    image_hw = recipe.clips.image_hw
    train_logs = [_recorded(*drive, size.train_seconds, image_hw, folder / "data") for drive in TRAIN_DRIVES]
    test_logs = [_recorded(*TEST_DRIVE, size.test_seconds, image_hw, folder / "data")]
    print(f"2/4  training {recipe.name}: the world model without labels, then the planner")
    run = train_run(recipe, train_logs, folder)
    print(f"3/4  judging it on {TEST_DRIVE[0]}, beside planners that see nothing")
    result = evaluate_run(run, test_logs, folder)
    print_summary(result.summary, Console(), recipe.name)
    print("4/4  drawing the report")
    inspections = inspect_run(run, test_logs, size.examples)
    write_report(folder / "report.html", report_on_run(run, test_logs, result, inspections))
    write_hero(folder / "hero.png", inspection_panel(inspections[0]))
    print(f"done in {time.perf_counter() - started:.0f} s: open {folder / 'report.html'}")


def _sized(recipe: "Recipe", size: Size) -> "Recipe":
    if size.steps is None:
        return recipe
    pretrain, finetune = (
        replace(stage, schedule=replace(stage.schedule, steps=steps, warmup_steps=1))
        for stage, steps in zip((recipe.pretrain, recipe.finetune), size.steps, strict=True)
    )
    return replace(recipe, pretrain=pretrain, finetune=finetune)


def _recorded(town: str, seed: int, seconds: float, image_hw: tuple[int, int], root: Path) -> "LogPath":
    """The drive's log, recorded now unless it is there."""
    from foredrive.data import find_logs
    from foredrive.towns.recorder import record, split_of
    from foredrive.towns.rig import camera_rig, roof_lidar
    from foredrive.towns.sensing import SensorSuite

    folder = root / "logs" / split_of(town) / f"{town}_seed{seed}"
    if folder.is_dir():
        return find_logs(folder)[0]
    return record(town, seconds, seed, root, RATE_HZ, SensorSuite(camera_rig(image_hw), roof_lidar()))
