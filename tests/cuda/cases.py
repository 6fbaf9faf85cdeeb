"""What the package does on a card, each in a function that returns figures: `python cases.py DEVICE CASE …`.

A case makes its input on the CPU and moves it, as the package does. Where the package chooses the device, it
finds the emulated one. The device "unusable" is a card that PyTorch finds and on which nothing can be done.
Prints a line of JSON for each case: its figures, or where and why it failed.
"""

import dataclasses
import json
import math
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
DEVICE, HOOKS, *NAMES = sys.argv[1:]
sys.path[:0] = [
    str(TESTS / "cuda"),
    str(TESTS.parent),
    *(str(TESTS / name) for name in ("", "data", "tasks", "sets", "runs", "driver")),
]

import emulation  # noqa: E402

COUNTS = emulation.Counts()
if DEVICE in ("cuda", "unusable"):
    emulation.start(Path(HOOKS))
if DEVICE == "cuda":
    import emulated_card

    COUNTS = emulated_card.begin()

import numpy as np  # noqa: E402
import shape_checks  # noqa: E402
import torch  # noqa: E402

shape_checks.install = lambda: None  # The shapes are checked by other tests

import builders  # noqa: E402
import conftest  # noqa: E402
import joint_heads  # noqa: E402
import miniature  # noqa: E402
import small_towers  # noqa: E402
import synthetic_log  # noqa: E402
import test_driver_run  # noqa: E402
import test_field_run  # noqa: E402
import test_likelihood  # noqa: E402
import test_tower_training  # noqa: E402
from transformers import BertConfig, BertModel  # noqa: E402

from foredrive.cli.main import main as program  # noqa: E402
from foredrive.data import ClipDataset, find_logs  # noqa: E402
from foredrive.driver.judging import judge_sight  # noqa: E402
from foredrive.driver.packed import PackedClips, join  # noqa: E402
from foredrive.engine.config import save_recipe  # noqa: E402
from foredrive.engine.summary import Summary, numbers, read_summary  # noqa: E402
from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig, PointCloud  # noqa: E402
from foredrive.methods.lidarclip.alignment import DistillationObjective, ImagedSweeps  # noqa: E402
from foredrive.methods.recipe import Recipe  # noqa: E402
from foredrive.methods.splatad import relocation  # noqa: E402
from foredrive.ops import photometric, precision, splatting, splatting_gsplat  # noqa: E402
from foredrive.ops.splat_points import pixel_points  # noqa: E402
from foredrive.runs.build import build_agent, build_objective  # noqa: E402
from foredrive.runs.drive.agents import make_agent  # noqa: E402
from foredrive.runs.evaluate.imagination import imagine_run  # noqa: E402
from foredrive.runs.reconstruction.reconstruct import reconstruct  # noqa: E402
from foredrive.runs.search.indexing import index_logs  # noqa: E402
from foredrive.runs.search.searching import ask  # noqa: E402
from foredrive.runs.search.tower_training import train_towers  # noqa: E402
from foredrive.runs.train.driver import load_driver, train_driver  # noqa: E402
from foredrive.runs.train.run import open_run  # noqa: E402
from foredrive.scene import Example  # noqa: E402
from foredrive.search.index import FrameIndex  # noqa: E402
from foredrive.search.query import Query  # noqa: E402
from foredrive.sensors.rigs import FRONT_TELE, camera_rig  # noqa: E402
from foredrive.sets import set_nll  # noqa: E402
from foredrive.towns.sensing.capture import SensorSuite  # noqa: E402
from foredrive.towns.virtual_egos import record_virtual_egos  # noqa: E402

# Kernels are held to plain PyTorch by tests/ops; no card is here that could start them
precision._has_triton = lambda: False  # type: ignore[assignment]
# Their last digits would grow over the steps of a reconstruction
photometric.numba_supports = relocation.numba_supports = lambda *_: False  # type: ignore[assignment]
Figures = dict[str, float]
CASES: dict[str, Callable[[Path], Figures]] = {}


def example_of(recipe: Recipe) -> Example:
    """Return a batch for a recipe, with the truth of its tasks, on the device."""
    clips = recipe.clips
    made = conftest.synthetic_example(past=clips.past_frames, future=clips.future_frames, spec=clips.voxels)
    return (
        joint_heads.with_truth(made, clips.tasks).to(DEVICE) if clips.tasks is not None else made.to(DEVICE)
    )


def steps_of(recipe: Recipe) -> Figures:
    """Return the losses of a step of each stage and the sums of gradients, and a plan."""
    example, figures = example_of(recipe), Figures()
    torch.manual_seed(0)
    agent = build_agent(recipe, fetch=False)
    for name, stage in (("pretrain", recipe.pretrain), ("finetune", recipe.finetune)):
        objective = build_objective(recipe, stage, agent).to(DEVICE)
        COUNTS.by_line.clear()
        losses = objective(example, torch.Generator().manual_seed(0))
        losses["loss"].backward()
        figures |= {f"{name}.{key}": float(value.detach()) for key, value in losses.items()}
        grads = [p.grad for p in objective.parameters() if p.grad is not None]
        figures[f"{name}.gradient"] = float(torch.stack([g.abs().sum() for g in grads]).sum())
        for p in objective.parameters():
            p.grad = None
    with torch.no_grad():
        seen = agent.eval()(example.clip.observed(), recipe.clips.future_frames)
    return figures | {"plan": float(seen.plan.xy.abs().sum())}


def nemo(_: Path) -> Figures:
    """NeMo's stages."""
    return steps_of(miniature.miniature())


def driveworld(_: Path) -> Figures:
    """DriveWorld's stages."""
    return steps_of(miniature.miniature_driveworld())


def heads(_: Path) -> Figures:
    """Heads of all tasks with NeMo."""
    return steps_of(joint_heads.with_small_heads(miniature.miniature(), attends=("agents", "map")))


def numbers_of(summary: Summary) -> Figures:
    """Return the figures of a summary that do not depend on the machine."""
    machine = ("machine.", "version.", "wall_s", "minutes", "peak", "memory", "_ms", "_s", "per_s")
    kept = {key: value for key, value in numbers(summary).items() if not any(word in key for word in machine)}
    return {key: value for key, value in kept.items() if math.isfinite(value)}


def verb(*words: object) -> None:
    """Run a verb on the device."""
    device = "cuda:0" if DEVICE == "cuda" else "cpu"
    assert program([*map(str, words), "--device", device]) == 0, words


def run(folder: Path) -> Figures:
    """`train` and `evaluate` of a run with heads, and its futures as `imagine` makes them."""
    log = miniature.with_map(miniature.write_log(folder), folder)
    save_recipe(joint_heads.with_small_heads(miniature.miniature()), folder / "own.yaml")
    made, split = folder / "run", log.folder.parent
    verb("train", folder / "own.yaml", "--logs", split, "--out", made)
    verb("evaluate", made, "--logs", split, "--examples", 0)
    figures = numbers_of(read_summary(made / "summary.json"))
    verb("imagine", made, log.folder, "--out", folder / "futures.webp", "--moments", 1)
    (imagined,) = imagine_run(open_run(made), log, samples=1, moments=1, ray_stride=4)
    figures["imagined"] = float(imagined.futures.float().mean())
    assert imagined.rendered is not None
    return figures | {"rendered": float(imagined.rendered.mean())}


def export(folder: Path) -> Figures:
    """`export` of a run that was trained on the CPU: it needs no card, and uses none that is there."""
    log = miniature.write_log(folder)
    save_recipe(miniature.miniature(), folder / "own.yaml")
    made, split = folder / "run", log.folder.parent
    for words in (
        ["train", folder / "own.yaml", "--logs", split, "--out", made, "--device", "cpu"],
        ["export", made, "--logs", split, "--clips", 1],
    ):
        assert program([*map(str, words)]) == 0, words
    differences = json.loads((made / "export" / "export.json").read_text())["largest_difference"]
    return {f"{runtime}_{name}": value for runtime, row in differences.items() for name, value in row.items()}


def driver(folder: Path) -> Figures:
    """A driver: its eyes and its planner, trained and judged, and a plan."""
    sensors = SensorSuite(camera_rig(plan=FRONT_TELE.of_size((32, 64))), None)
    logs = record_virtual_egos("Town02", 3, 2, folder, sensors)
    recipe = test_driver_run.recipe()
    trained = load_driver(train_driver(recipe, logs, folder / "run", folder / "cache"))
    clips = PackedClips(ClipDataset(logs, recipe.clips, None), folder / "cache" / "packed")
    agent = make_agent(str(folder / "run"), lambda: 0.0)
    plan = agent.act(join([clips[0]]).clip)
    return {"plan": float(plan.xy.abs().sum()), **numbers_of(judge_sight(trained, clips))}


def search(folder: Path) -> Figures:
    """Towers trained on a log, an index made with them, and a query."""
    log, text = miniature.write_log(folder, frames=21), folder / "bert"
    small_towers.save_tokenizer(text)
    torch.manual_seed(0)
    BertModel(BertConfig(vocab_size=len(small_towers.WORDS), **small_towers.SMALL)).save_pretrained(text)
    recipe = test_tower_training.small_recipe(str(text))
    towers = train_towers(recipe, [log], folder / "towers")
    index_logs([log], str(folder / "index"), str(towers), 0.5, workers=1)
    found = ask(FrameIndex(str(folder / "index")), Query(text="a car at night", top=3)).hits
    return {f"score_{place}": float(hit.score) for place, hit in enumerate(found)}


def gaussians(folder: Path) -> Figures:
    """`reconstruct` with Gaussians, from end to end."""
    done = builders.reconstructed_log(folder, frames=5)
    return numbers_of(done.summary)


def gsplat(folder: Path) -> Figures:
    """The same with gsplat installed, for whose kernels the reference stands: images have to reach it."""
    reached = []

    def composite(*parts: torch.Tensor, size_hw: tuple[int, int]) -> tuple[torch.Tensor, ...]:
        reached.append(size_hw)
        mean, inverse_covariance, opacity, range_m, feature = parts
        still = (torch.zeros_like(mean), torch.zeros_like(mean), torch.zeros_like(range_m))
        splats = splatting.Splats(mean, inverse_covariance, opacity, range_m, *still, feature)
        seen = splatting.composite_splats_reference(splats, pixel_points(size_hw).to(DEVICE))
        return seen.feature, seen.expected_range_m, seen.alpha

    splatting_gsplat.gsplat_compiles = lambda: True  # type: ignore[assignment]
    splatting_gsplat.composite_gsplat = lambda *given: composite(*given[:5], size_hw=given[5])  # type: ignore
    figures = gaussians(folder)
    assert bool(reached) == (DEVICE == "cuda"), reached
    return figures


def field(folder: Path) -> Figures:
    """`reconstruct` with a neural field, from end to end."""
    (log,) = find_logs(synthetic_log.write(folder, frames=5))
    return numbers_of(reconstruct(test_field_run.recipe(), log, folder / "run").summary)


def sets(_: Path) -> Figures:
    """The set likelihood with its gradient."""
    rng, figures = np.random.default_rng(1), Figures()
    for place in range(6):
        process, objects = (
            on_device(part) for part in test_likelihood.random_scene(rng, background=place % 2 > 0)
        )
        mean = process.detected.boxes.mean.clone().requires_grad_()
        boxes = dataclasses.replace(process.detected.boxes, mean=mean)
        process = dataclasses.replace(process, detected=dataclasses.replace(process.detected, boxes=boxes))
        nll = set_nll(process, objects).nll
        if bool(nll.isfinite()) and len(objects.label):
            nll.backward()
            figures |= {
                f"{place}.nll": float(nll.detach()),
                f"{place}.gradient": float(mean.grad.abs().sum()),
            }
    return figures


def on_device(value: Any) -> Any:
    """Return a record of tensors on the device."""
    if isinstance(value, torch.Tensor):
        return value.to(DEVICE)
    if not dataclasses.is_dataclass(value):
        return value
    parts = {
        part.name: on_device(getattr(value, part.name)) for part in dataclasses.fields(value) if part.init
    }
    return dataclasses.replace(value, **parts)  # type: ignore[type-var]


def alignment(_: Path) -> Figures:
    """LidarCLIP's objectives."""
    torch.manual_seed(0)
    encoder = LidarEncoder(LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=2), dim=4)
    cloud = PointCloud(torch.rand(100, 4), torch.arange(2).repeat_interleave(50))
    sweeps = ImagedSweeps(cloud, torch.rand(2, 2, 4), ("a", "b")).to(DEVICE)
    loss = DistillationObjective(encoder, "mse").to(DEVICE)(sweeps, torch.Generator().manual_seed(0))["loss"]
    loss.backward()
    gradient = torch.stack([p.grad.abs().sum() for p in encoder.parameters() if p.grad is not None]).sum()
    return {"loss": float(loss.detach()), "gradient": float(gradient)}


CASES |= {"nemo": nemo, "driveworld": driveworld, "heads": heads, "run": run, "gaussians": gaussians}
CASES["gsplat"] = gsplat
CASES |= {
    "export": export,
    "field": field,
    "sets": sets,
    "alignment": alignment,
    "driver": driver,
    "search": search,
}


def main() -> None:
    """Run the cases."""
    warnings.simplefilter("ignore")
    for name in NAMES or CASES:
        began = time.perf_counter()
        try:
            with tempfile.TemporaryDirectory() as folder:
                outcome: dict[str, object] = {"figures": (CASES | {"export": export})[name](Path(folder))}
        except Exception as error:
            own = [f for f in traceback.extract_tb(error.__traceback__) if emulation.PACKAGE in f.filename]
            lines = [f"{f.filename.rpartition(emulation.PACKAGE)[2]}:{f.lineno}" for f in own[-4:]]
            outcome = {"error": f"{type(error).__name__}: {str(error)[:300]}", "lines": lines}
        counted = {f"{kind}, {line}": n for (kind, line), n in COUNTS.by_line.most_common()}
        seconds = time.perf_counter() - began
        print(
            json.dumps({"case": name, "seconds": round(seconds, 2), **outcome, "counts": counted}), flush=True
        )


if __name__ == "__main__":
    main()
