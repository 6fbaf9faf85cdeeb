"""Gates before any long training: heads find what is put into their features."""

import dataclasses
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from benchmarks.common.true_planes import CHANNELS, SPEC, draw
from foredrive.data import ClipDataset, collate
from foredrive.engine.summary import numbers
from foredrive.heads.heads import TaskHeads, TaskVolume
from foredrive.heads.losses import task_losses
from foredrive.runs.drive.recording import EgosPlan, record_egos
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.task_heads import town_heads
from foredrive.scene import Example
from foredrive.sensors.rigs import SURROUND, RigPlan
from foredrive.tasks.detection.detection_metric import DetectionMetric
from foredrive.tasks.maps.map_lines_metric import MapLinesMetric
from foredrive.tasks.metric import EvaluationContext, Metric
from foredrive.tasks.motion.motion_metric import MotionMetric
from foredrive.tasks.predictor import Prediction

EGOS, FRAMES, BATCH, RATE = 8, 16, 4, 3e-3
TRUTH = dataclasses.replace(town_heads(["detection", "motion", "map"]).truth, raster=None)
Frames = tuple[Example, Tensor]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    """Two frames of each of some cars in traffic, and their true surroundings from above."""
    rig = RigPlan((4, 6), dict(list(SURROUND.cameras.items())[:1]))
    logs, failed = record_egos([EgosPlan("Town02", 2000, EGOS, ())], tmp_path_factory.mktemp("egos"), rig, 1)
    assert not failed
    clips = dataclasses.replace(
        find_recipe("nemo_town").clips, voxels=SPEC, map=True, tasks=TRUTH, cameras=()
    )
    dataset = ClipDataset(logs, dataclasses.replace(clips, future_frames=0), None)
    examples = [dataset[index] for index in range(0, len(dataset), len(dataset) // FRAMES)][:FRAMES]
    return collate(examples), torch.stack([draw(example.clip, []) for example in examples])[:, :, None]


def learned(tasks: Sequence[str], frames: Frames, steps: int) -> TaskHeads:
    """Heads that have learned the frames by heart."""
    truth, planes = frames
    torch.manual_seed(0)
    recipe = town_heads(tasks)
    heads = TaskHeads(dataclasses.replace(recipe.heads, raster=None, past=False), SPEC, channels=CHANNELS)
    optimizer = torch.optim.AdamW(heads.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps, pct_start=0.1)
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        rows = torch.randperm(FRAMES, generator=generator)[:BATCH]
        clip, of_rows = truth.clip[rows], truth[rows].truth
        assert of_rows is not None
        output = heads({"occupancy": TaskVolume(planes[rows])})
        boxes, known = clip.boxes[:, clip.now], clip.boxes_valid[:, clip.now]
        losses = task_losses(output, boxes, known, of_rows, SPEC, None, recipe.weights)
        optimizer.zero_grad()
        losses["loss"].backward()
        torch.nn.utils.clip_grad_norm_(heads.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    return heads.eval()


@torch.no_grad()
def figures(heads: TaskHeads, frames: Frames, sight: float) -> dict[str, float]:
    """The figures of the frames; with a `sight` of 0 the planes are blacked."""
    truth, planes = frames
    output = heads({"occupancy": TaskVolume(sight * planes)})
    agents = output.agents and output.agents[-1].agents(TRUTH.future_dt_s)
    lines = output.elements and output.elements[-1].lines()
    metrics: list[Metric] = [start(EvaluationContext(0.5)) for start in (MapLinesMetric,) if lines]
    metrics += [start(EvaluationContext(0.5)) for start in (DetectionMetric, MotionMetric) if agents]
    summary = {}
    for metric in metrics:
        metric.update(Prediction(agents=agents, map_lines=lines), truth)
        summary |= numbers(metric.result())
    return summary


def test_road_users_and_their_futures_are_found(frames: Frames) -> None:
    heads = learned(["detection", "motion"], frames, 700)
    seen, blacked = (figures(heads, frames, sight) for sight in (1.0, 0.0))
    assert seen["car_ap_2m_30m"] > 0.9 * seen["car_ap_2m_30m.ceiling"] > 0.85
    assert blacked["car_ap_2m_30m"] < 0.1
    assert seen["uniad.car.min_ade_m"] < 0.5 * seen["uniad.car.min_ade_m.constant_velocity"]


def test_lines_are_found(frames: Frames) -> None:
    heads = learned(["map"], frames, 350)
    seen, blacked = (figures(heads, frames, sight) for sight in (1.0, 0.0))
    assert seen["maptr.map"] > 0.9 * seen["maptr.map.ceiling"] > 0.85
    assert blacked["maptr.map"] < 0.3
