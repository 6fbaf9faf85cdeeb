"""Time of a training step of DriveWorld and of NeMo on the same clips: `foredrive bench driveworld_speed`.

Twenty seconds of Town01 are recorded first. The models take turns, so that a busy machine slows both alike;
their ratio is one of CPU times, on a GPU of wall times. If there is a GPU, the base size is measured too.
"""

import dataclasses
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.common.benchmark import Benchmark
from benchmarks.common.measuring import Took, forget_peak, measure, peak_mib
from foredrive.data import collate
from foredrive.engine.fabric import make_fabric
from foredrive.methods.recipe import Recipe
from foredrive.runs.build import build_agent, build_objective
from foredrive.runs.drive.recording import record_drives
from foredrive.runs.open_clips import open_clips
from foredrive.runs.recipes.known import RECIPES
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.campaign import Campaign, plan_drives

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
PLANS = plan_drives(Campaign(("Town01",), (1,), seconds=20.0, rate_hz=2.0))
TURNS = 7
STAGES = ("pretrain", "finetune")


class Stepper:
    """A recipe's stage with its optimizer and one batch, ready for training steps."""

    def __init__(self, recipe: Recipe, stage_name: str, folder: Path, seed: int) -> None:
        stage = recipe.pretrain if stage_name == "pretrain" else recipe.finetune
        assert stage is not None
        logs = list(record_drives(PLANS, folder / "towns", SURROUND, workers=1).logs.values())
        dataset = open_clips(logs, dataclasses.replace(recipe.clips, future_images=True), folder / "cache")
        size = stage.schedule.batch_size
        torch.manual_seed(seed)
        self.fabric = make_fabric(recipe.precision)
        items = [dataset[int(k * len(dataset) / size)] for k in range(size)]
        self.example = collate(items).to(self.fabric.device)
        objective = build_objective(recipe, stage, build_agent(recipe, fetch=False))
        trained = [p for p in objective.parameters() if p.requires_grad]
        optimizer = torch.optim.AdamW(trained, lr=stage.schedule.lr)
        self.objective, self.optimizer = self.fabric.setup(objective, optimizer)

    def step(self) -> None:
        """Do one step as `training.train` does."""
        loss = self.objective(self.example, torch.Generator().manual_seed(0))["loss"]
        self.optimizer.zero_grad(set_to_none=True)
        self.fabric.backward(loss)
        self.fabric.clip_gradients(self.objective, self.optimizer, max_norm=35.0)
        self.optimizer.step()


def beside(name: str, nemo: str) -> Callable[[int], dict[str, float]]:
    """Return an arm that measures steps of a DriveWorld and of a NeMo in turns."""

    def run(seed: int) -> dict[str, float]:
        figures: dict[str, float] = {}
        with tempfile.TemporaryDirectory() as folder:
            for stage in STAGES:
                mine, theirs = (Stepper(RECIPES[each], stage, Path(folder), seed) for each in (name, nemo))
                took: dict[str, list[Took]] = {"": [], "nemo_": []}
                for _ in range(TURNS + 1):  # the first ones warm up
                    took[""].append(measure(mine.step, 1, DEVICE))
                    took["nemo_"].append(measure(theirs.step, 1, DEVICE))
                figures |= _figures(stage, took)
                forget_peak(DEVICE)
                mine.step()
                figures[f"{stage}.peak_mib"] = peak_mib(DEVICE)
        headline = {name: figures[f"pretrain.{name}"] for name in ("step_s", "ratio_to_nemo")}
        return headline | figures

    return run


def _figures(stage: str, took: dict[str, list[Took]]) -> dict[str, float]:
    """Return medians without the first turn, and ratios of CPU times on a CPU, of wall times on a GPU."""
    figures = {}
    for model, turns in took.items():
        for kind in ("wall_s", "cpu_s"):
            figures[f"{model}{kind}"] = statistics.median(getattr(turn, kind) for turn in turns[1:])
    kind = "wall_s" if DEVICE == "cuda" else "cpu_s"
    return {
        f"{stage}.step_s": figures["wall_s"],
        f"{stage}.step_cpu_s": figures["cpu_s"],
        f"{stage}.nemo_step_s": figures["nemo_wall_s"],
        f"{stage}.nemo_step_cpu_s": figures["nemo_cpu_s"],
        f"{stage}.ratio_to_nemo": figures[kind] / figures[f"nemo_{kind}"],
    }


BENCHMARK = Benchmark(
    question="How long does a training step of DriveWorld take beside one of NeMo at equal resolution?",
    arms={"tiny": beside("driveworld_tiny", "nemo_tiny")}
    | ({"base": beside("driveworld_base", "nemo_base")} if DEVICE == "cuda" else {}),
    config={
        "recipes": {
            name: dataclasses.asdict(RECIPES[name])
            for name in ("driveworld_tiny", "nemo_tiny", "driveworld_base", "nemo_base")
        },
        "turns": TURNS,
    },
)
