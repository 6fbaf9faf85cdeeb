"""Possible gain of NeMo's planner from perfect perception: `foredrive bench nemo-planning-limits`.

The planner of `nemo_town` is trained on the demonstrations of the studies. The true map and the true boxes,
drawn from above, replace the features of a volume. It uses as few demonstrations as fine-tuning can afford on
two cores, and 16 times as many. No encoder can bring a gain that the planner does not reach here.
"""

import dataclasses
import functools
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor, nn

from benchmarks.common.study import StudyTowns, record_study, work_folder
from foredrive.data import ClipDataset, LogPath
from foredrive.data.batches import stack_records
from foredrive.engine.bench import Benchmark
from foredrive.geometry.boxes import points_in_boxes
from foredrive.methods.planner.ego_mlp import EgoMLP, EgoMLPConfig, ego_motion
from foredrive.methods.planner.ego_mlp_fit import EgoMLPFit, fit_ego_mlp, read_status
from foredrive.methods.planner.path_correction import PathCorrectionConfig
from foredrive.methods.planner.planner import VolumePlanner
from foredrive.runs.recipes.known import find_recipe
from foredrive.scene import Boxes, Category, Clip, MapKind, MapPatch, Trajectory, VoxelSpec
from foredrive.tasks.planning.losses import waypoint_loss

WORK = work_folder(Path("runs/nemo_study"))
TOWNS = StudyTowns()
RECIPE = find_recipe("nemo_town")
KINDS = (MapKind.LANE_CENTRE, MapKind.ROAD_EDGE, MapKind.CROSSWALK, MapKind.WALKWAY, MapKind.STOP_ZONE)
CHANNELS = len(KINDS) + 3
"""Number of channels: one for each kind, the vehicles now, the vehicles one key frame ago, the pedestrians
now.
"""
HIDDEN = 32
BATCH, LEARNING_RATE = 8, 1e-3
SEEN = (2_000, 8_000, 32_000)
"""Number of demonstrations used in training, with repetition."""
PER_SEGMENT = 16
"""Number of points drawn for each segment of a line."""


class Scenes(NamedTuple):
    """Clips and the true surroundings of each."""

    clip: Clip
    """A batch of all clips, without images."""
    truth: Float[Tensor, "N K 1 Y X"]


def plane(spec: VoxelSpec) -> VoxelSpec:
    """Return the grid with one voxel of height."""
    return dataclasses.replace(spec, shape_zyx=(1, *spec.shape_zyx[1:]))


def draw(clip: Clip, spec: VoxelSpec) -> Float[Tensor, "K Y X"]:
    """Draw the true surroundings of one clip from above."""
    assert clip.map is not None
    image = torch.zeros(CHANNELS, *spec.shape_zyx[1:])
    for channel, kind in enumerate(KINDS):
        _draw_lines(image[channel], clip.map, kind, spec)
    now, before = (clip.boxes.map_tensors(itemgetter(k)) for k in (clip.now, clip.now - 1))
    walks = now.category == int(Category.PEDESTRIAN)
    T_ego_world = torch.linalg.inv(clip.T_world_ego[clip.now])
    T_now_before = (T_ego_world @ clip.T_world_ego[clip.now - 1]).float()
    still = torch.eye(4)
    for channel, boxes, chosen, T in (
        (-3, now, now.valid & ~walks, still),
        (-2, before, before.valid, T_now_before),
        (-1, now, now.valid & walks, still),
    ):
        image[channel] = _boxes_from_above(boxes, chosen, T, spec)
    return image


def _draw_lines(image: Float[Tensor, "Y X"], lines: MapPatch, kind: MapKind, spec: VoxelSpec) -> None:
    chosen = lines.kind == int(kind)
    start, end = lines.vertices[chosen, :-1, :2], lines.vertices[chosen, 1:, :2]
    start, end = (ends[lines.valid[chosen, 1:]] for ends in (start, end))
    share = torch.linspace(0, 1, PER_SEGMENT)[:, None, None]
    cells = ((start + share * (end - start) - torch.tensor(spec.lower_m[:2])) / spec.voxel_m).floor().long()
    x, y = cells.flatten(0, 1).unbind(-1)
    inside = (x >= 0) & (y >= 0) & (x < image.shape[1]) & (y < image.shape[0])
    image[y[inside], x[inside]] = 1.0


def _boxes_from_above(
    boxes: Boxes, chosen: Tensor, T_now_boxes: Float[Tensor, "4 4"], spec: VoxelSpec
) -> Float[Tensor, "Y X"]:
    """Return the cells whose centre is at most half a cell from a box.

    Boxes of another time come with the pose of their frame.
    """
    middles = spec.centres_m()[0]
    there = torch.linalg.inv(T_now_boxes)
    flat = middles @ there[:3, :3].T + there[:3, 3]
    flat = torch.cat([flat[..., :2], torch.zeros_like(flat[..., :1])], dim=-1)
    centre = boxes.centre[chosen] * torch.tensor([1.0, 1.0, 0.0])
    size = boxes.size_lwh[chosen] + spec.voxel_m
    inside = points_in_boxes(flat.flatten(0, 1), centre, size, boxes.yaw[chosen])
    return inside.any(-1).view(flat.shape[:2]).float()


def read_scenes(logs: tuple[LogPath, ...], what: str) -> Scenes:
    """Read all clips of some logs."""
    config = dataclasses.replace(RECIPE.clips, cameras=(), future_frames=0, future_images=False, map=True)
    dataset, spec = ClipDataset(logs, config, None), plane(config.voxels)
    clips, images = [], []
    for index in track(range(len(dataset)), description=f"drawing {what}"):
        clip = dataset.clip(index)
        images.append(draw(clip, spec).to(torch.uint8))
        clips.append(dataclasses.replace(clip, map=None))
    return Scenes(stack_records(clips), torch.stack(images)[:, :, None])


@functools.cache
def scenes() -> tuple[Scenes, Scenes, EgoMLP]:
    """Return the training scenes, the test scenes, and the MLP that both planners start from."""
    logs = record_study(TOWNS, WORK / "towns", workers=2)
    train, test = read_scenes(logs.train, "demonstrations"), read_scenes(logs.test, "tests")
    past_frames, dt_s = RECIPE.planner.history, RECIPE.clips.horizon_dt_s
    status = read_status([train.clip], past_frames)
    fitted = fit_ego_mlp(EgoMLPConfig(), status, EgoMLPFit(), past_frames=past_frames, dt_s=dt_s)
    return train, test, fitted


class Sighted(nn.Module):
    """NeMo's planner on a plane with the truth, after three convolutions."""

    def __init__(self, ego_mlp: EgoMLP, path: PathCorrectionConfig | None) -> None:
        super().__init__()
        clips = RECIPE.clips
        self.see = nn.Sequential(
            nn.Conv2d(CHANNELS, HIDDEN, 3, padding=1), nn.ReLU(),
            nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1), nn.ReLU(),
            nn.Conv2d(HIDDEN, HIDDEN, 3, padding=1),
        )  # fmt: skip
        self.planner = VolumePlanner(
            dataclasses.replace(RECIPE.planner, future="none", pool=(1, 1, 1), path=path),
            plane(clips.voxels),
            channels=HIDDEN,
            horizon_steps=clips.horizon_steps,
            dt_s=clips.horizon_dt_s,
        )
        self.planner.ego_mlp = ego_mlp.requires_grad_(False)

    def forward(self, scenes: Scenes) -> Trajectory:
        """Return the plan of every clip."""
        clip = scenes.clip
        volume = self.see(scenes.truth[:, :, 0].float())[:, :, None]
        poses, speeds = ego_motion(clip, self.planner.history)
        past = torch.cat([poses, speeds[:, :-1, None]], dim=-1)
        status = (clip.command, clip.command_valid, speeds[:, -1], clip.ego_speed_valid[:, clip.now], past)
        return self.planner(volume, None, *status)


def planned(seen: int, path: PathCorrectionConfig | None) -> Callable[[int], dict[str, float]]:
    """Return an arm that trains on `seen` demonstrations, with or without path features of the plane."""

    def measure(seed: int) -> dict[str, float]:
        train, test, ego_mlp = scenes()
        torch.manual_seed(seed)
        model = Sighted(ego_mlp, path)
        steps = seen // BATCH
        optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=LEARNING_RATE)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        order = torch.Generator().manual_seed(seed)
        for _ in track(range(steps), description=f"{seen} demonstrations"):
            chosen = torch.randint(len(train.truth), (BATCH,), generator=order)
            batch = _pick(train, chosen)
            loss = waypoint_loss(model(batch), batch.clip.future)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
        own, rival = _errors_m(model.eval(), test, ego_mlp)
        return {"l2_m": own, "ego_mlp_l2_m": rival}

    return measure


def _pick(scenes: Scenes, chosen: Tensor) -> Scenes:
    return Scenes(scenes.clip.map_tensors(lambda tensor: tensor[chosen]), scenes.truth[chosen])


@torch.no_grad()
def _errors_m(model: Sighted, test: Scenes, ego_mlp: EgoMLP) -> tuple[float, float]:
    """Return the mean distance to the driven path of the planner and of the MLP, over all complete plans."""
    errors = []
    for chosen in torch.arange(len(test.truth)).split(64):
        batch = _pick(test, chosen)
        driven = batch.clip.future
        whole = driven.valid[:, 0].all(-1)
        plans = (model(batch), ego_mlp.act(batch.clip))
        errors.append(torch.stack([(plan.xy - driven.xy)[whole, 0].norm(dim=-1) for plan in plans], dim=-1))
    own, rival = torch.cat(errors).mean(dim=(0, 1)).tolist()
    return own, rival


BENCHMARK = Benchmark(
    question="What could NeMo's planner gain by looking if it saw perfectly?",
    arms={f"seen_{seen}": planned(seen, RECIPE.planner.path) for seen in SEEN}
    | {f"seen_{seen}_without_path": planned(seen, None) for seen in SEEN[:-1]},
    seeds=(0,),
    config={
        "recipe": dataclasses.asdict(RECIPE),
        "towns": dataclasses.asdict(TOWNS),
        "batch": BATCH,
        "lr": LEARNING_RATE,
    },
)
