"""A world model that the package does not know: one row of a table takes it through everything."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from jaxtyping import Float
from miniature import miniature
from torch import Tensor, nn

from foredrive.data import ClipConfig, LogPath
from foredrive.engine.loop import Schedule
from foredrive.errors import InputError
from foredrive.heads.joint import TaskTerms
from foredrive.heads.plan_losses import waypoint_loss
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.recipe import Recipe
from foredrive.runs import Run, evaluate_run, open_run, predict_examples, train_run
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.route_source import job_of
from foredrive.runs.drive.suite import DriveSuite, drive_one
from foredrive.runs.evaluate.imagination import imagine_run
from foredrive.runs.export import export_run
from foredrive.runs.recipes.world_models import WORLD_MODELS, WorldModelEntry, load_recipe
from foredrive.scene import Belief, Clip, Decoded, Example, Frames, Task, VoxelSpec, WorldModel, last_frames
from foredrive.sensors.rigs import SURROUND
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.traffic.lane_graph import build_lane_graph
from foredrive.view.log_frames import LogFrames
from foredrive.view.viewer import Viewer


@dataclass(frozen=True)
class FrozenConfig:
    channels: int
    kind: Literal["frozen"] = "frozen"


@dataclass(frozen=True)
class FrozenStage:
    schedule: Schedule
    kind: Literal["frozen"] = "frozen"


class FrozenWorld(nn.Module):
    """Believes in one learned volume, scaled by the mean brightness of the images, that never changes."""

    samples_futures = False
    max_steps = None
    renderer = None

    def __init__(self, config: FrozenConfig, clips: ClipConfig) -> None:
        super().__init__()
        self.spec, self.channels = clips.voxels, config.channels
        self.past_frames, self.dt_s = clips.past_frames, clips.frame_dt_s
        self.volume = nn.Parameter(torch.randn(config.channels, *clips.voxels.shape_zyx))

    def observe(self, clip: Clip) -> Belief:
        return self.encode(last_frames(clip, self.past_frames))

    def encode(self, frames: Frames) -> Belief:
        brightness = frames.images[:, -1].float().mean(dim=(1, 2, 3, 4)) / 255
        return Belief(volume=brightness[:, None, None, None, None] * self.volume)

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K A"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        still = torch.eye(4).expand(len(belief.volume), 4, 4)
        return [replace(belief, T_now_ego=still) for _ in range(steps)]

    def decode(self, belief: Belief) -> Decoded:
        return Decoded(occupancy_logit=belief.volume.mean(dim=1), feature=belief.volume)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        return belief.volume


class FrozenObjective(nn.Module):
    def __init__(self, agent: PlanningAgent[FrozenWorld]) -> None:
        super().__init__()
        self.agent = agent

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        output = self.agent(example.clip.observed(), 0)
        return {"loss": waypoint_loss(output.plan, example.clip.future)}


def build(config: FrozenConfig, clips: ClipConfig, fetch: bool) -> FrozenWorld:
    return FrozenWorld(config, clips)


def objective(
    stage: FrozenStage, agent: PlanningAgent[Any], clips: ClipConfig, tasks: TaskTerms | None
) -> FrozenObjective:
    return FrozenObjective(agent)


def recipe() -> Recipe[FrozenConfig, FrozenStage]:
    small = miniature()
    voxels = VoxelSpec(lower_m=(-16.0, -16.0, -1.0), voxel_m=2.0, shape_zyx=(2, 16, 16))
    return Recipe(
        name="frozen",
        clips=replace(small.clips, voxels=voxels),
        model=FrozenConfig(channels=4),
        planner=small.planner,
        pretrain=None,
        finetune=FrozenStage(Schedule(batch_size=2, lr=1e-3, steps=2, warmup_steps=1)),
    )


@pytest.fixture(scope="module", autouse=True)
def known() -> Iterator[None]:
    """The one row that a new world model adds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(WORLD_MODELS, "frozen", WorldModelEntry(FrozenConfig, FrozenStage, build, objective))
        yield


@pytest.fixture(scope="module")
def run(log: LogPath, known: None, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train_run(recipe(), [log], tmp_path_factory.mktemp("frozen"))


def test_it_is_a_world_model_and_its_recipe_is_read_back(run: Run) -> None:
    assert isinstance(FrozenWorld(FrozenConfig(channels=4), recipe().clips), WorldModel)
    assert load_recipe(run.folder / "config.yaml") == recipe()
    assert open_run(run.folder).weights.is_file()


def test_it_is_evaluated_and_looked_at(run: Run, log: LogPath, tmp_path: Path) -> None:
    summary = evaluate_run(run, [log], tmp_path).summary
    assert summary["failed"] == 0
    assert 0 <= summary["occupancy.above_ground.iou_now"] < 1
    (seen,) = predict_examples(run, [log], 1)
    assert seen.rendered is None
    (imagined,) = imagine_run(run, log, seconds=2.0, samples=3, moments=1)  # beyond the recipe's own future
    assert imagined.futures.shape[:2] == (1, 5)
    assert imagined.rendered is None


def test_it_is_viewed(run: Run, log: LogPath) -> None:
    viewer = Viewer(LogFrames(log, 96, run), "localhost", 0)
    viewer.show(20)  # far enough into the log for a clip
    assert viewer.server.scene.get_handle_by_name("/plan") is not None
    viewer.close()


def test_it_is_exported(run: Run, log: LogPath, tmp_path: Path) -> None:
    facts = export_run(run, [log], tmp_path, clips=1)
    assert facts["largest_difference"]["model.onnx"]["waypoints_xy"] < 1e-4


def test_it_knows_its_rig(run: Run) -> None:
    """Its own rig is the default; another one is refused before anything is driven, unless it is wanted."""
    agent = str(run.folder)
    own = rig_of(agent)
    assert set(own.cameras) == {"PCAM_F0", "PCAM_L0"}
    with pytest.raises(InputError, match="was trained with the cameras PCAM_F0, PCAM_L0, not PCAM_F0, "):
        TownRoutes("town05-short", rig=SURROUND).jobs(agent)
    for source in (TownRoutes("town05-short", rig=own), TownRoutes("town05-short", other_rig=True)):
        assert len(source.jobs(agent)) == 32


def test_it_drives(run: Run, tmp_path: Path) -> None:
    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    ends = graph.position(np.full(2, lane), np.array([20.0, 26.0]))
    points = "".join(f'<waypoint x="{x}" y="{-y}" z="{z}"/>' for x, y, z in ends)
    routes = tmp_path / "one.xml"
    routes.write_text(f'<routes><route id="a" town="Town02">{points}</route></routes>')
    source = TownRoutes(str(routes), rig=SURROUND.of_size((18, 32)), vehicles=2, people=0)
    drive = drive_one(job_of("a", 0), DriveSuite(str(run.folder), source), tmp_path / "drives")
    assert not drive.error
    assert len(drive.act_s) > 0
