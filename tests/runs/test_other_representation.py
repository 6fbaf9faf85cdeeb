"""Another representation than Gaussians, in this file: reconstructed, opened, edited, rendered, evaluated.

The scene is a flat ground under a sky and a box for each actor, each of one learned colour and intensity.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
import synthetic_log as world
import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.cli.main import main
from foredrive.data import LogPath, find_logs
from foredrive.engine.learning_rates import Rate
from foredrive.errors import InputError
from foredrive.geometry.projection import pixel_centres, pixels_to_rays
from foredrive.geometry.se3 import inverse_se3, rotate_vectors, transform_points
from foredrive.methods.reconstruction.edits import DriveStraight, Duplicate, Insert, Remove, apply_edits
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.novel_views import novel_camera_view
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene, saved_tracks
from foredrive.methods.reconstruction.rendered import RenderedImage, RenderedSweep
from foredrive.methods.reconstruction.scene_graph import STATIC, Content, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks, states_at
from foredrive.methods.reconstruction.training import ParameterGroup, SensorViews, StepLosses, ViewOrder
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.losses import intensity_loss
from foredrive.runs.recipes import reconstruction
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct
from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction
from foredrive.scene.record import Record


@dataclass(frozen=True)
class BoxContent(Record):
    """Red, green, blue and intensity of the ground, and of each actor."""

    ground: Float[Tensor, "4"]
    actors: Float[Tensor, "A 4"]

    @property
    def device(self) -> torch.device:
        return self.ground.device

    def without(self, row: int) -> "BoxContent":
        others = torch.arange(len(self.actors)) != row
        return BoxContent(self.ground, self.actors[others])

    def with_copy(self, source: Content, source_row: int, row: int) -> "BoxContent":
        if not isinstance(source, BoxContent):
            raise InputError("an actor that is not a box does not fit into a scene of boxes")
        return BoxContent(self.ground, torch.cat([self.actors, source.actors[source_row : source_row + 1]]))

    def evidence(self, row: int) -> int:
        return 1

    def preview(self, row: int) -> Gaussians:
        rgb = (self.ground if row == STATIC else self.actors[row])[None, :3]
        return Gaussians(
            torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.zeros(1), rgb
        )


class BoxScene(ReconstructedScene):
    def __init__(self, tracks: ActorTracks, cameras: int, reach_m: float) -> None:
        super().__init__(tracks, cameras, reach_m, frames=0)
        self.ground = nn.Parameter(torch.full((4,), 0.5))
        self.actors = nn.Parameter(torch.full((len(tracks), 4), 0.5))
        self.sky = nn.Parameter(torch.full((3,), 0.5))

    @property
    def content(self) -> BoxContent:
        return BoxContent(self.ground, self.actors)

    @property
    def sizes(self) -> dict[str, int]:
        return {"boxes": len(self.actors)}

    def camera(self, graph: SceneGraph, view: CameraView) -> RenderedImage:
        exposed = self.corrected_camera(view)
        rays = pixels_to_rays(pixel_centres(view.size_hw).flatten(0, 1), view.K, view.dist)
        origin = exposed.T_scene_cam[:3, 3].expand(len(rays), 3)
        looks, range_m = seen(graph, origin, rotate_vectors(exposed.T_scene_cam, rays), exposed.t_s)
        rgb = torch.where(range_m.isfinite()[:, None], looks[:, :3], self.sky)
        hit = range_m.isfinite().float().unflatten(0, view.size_hw)
        return RenderedImage(rgb.T.unflatten(1, view.size_hw), range_m.unflatten(0, view.size_hw), hit)

    def prepare_sweep(self, view: SweepView) -> tuple[Tensor, Tensor]:
        direction = rotate_vectors(view.T_scene_ego, view.beams.dir_ego)
        return transform_points(view.T_scene_ego, view.beams.origin_ego), direction

    def sweep(self, graph: SceneGraph, points: Any, t_s: float) -> RenderedSweep:
        looks, range_m = seen(graph, *points, t_s)
        hit = (range_m < self.reach_m).float()
        logit = torch.where(hit > 0, -4.0, 4.0)
        return RenderedSweep(range_m, range_m, looks[:, 3], logit, hit, None)


def seen(graph: SceneGraph, origin: Tensor, direction: Tensor, t_s: float | Tensor) -> tuple[Tensor, Tensor]:
    """Looks and range of the first surface on each ray; the range is infinite in the sky."""
    content, states = graph.content, states_at(graph.tracks, t_s)
    assert isinstance(content, BoxContent)
    down = direction[:, 2] < 0
    range_m = torch.where(down, -origin[:, 2] / direction[:, 2], torch.inf)
    looks = content.ground.expand(len(direction), 4)
    for row in states.present.nonzero()[:, 0].tolist():
        T, half = inverse_se3(states.T_scene_actor[row]), graph.tracks.size_lwh[row] / 2
        own, along = transform_points(T, origin), rotate_vectors(T, direction)
        sides = torch.stack([(-half - own) / along, (half - own) / along])
        enter, leave = sides.amin(0).amax(-1), sides.amax(0).amin(-1)
        hit = (enter <= leave) & (enter > 0) & (enter < range_m)
        range_m = torch.where(hit, enter.detach(), range_m)
        looks = torch.where(hit[:, None], content.actors[row], looks)
    return looks, range_m


@dataclass(frozen=True)
class BoxSchedule:
    steps: int = 12
    checkpoint_every: int = 100
    seed: int = 0


class BoxTraining:
    def __init__(self, scene: BoxScene, views: SensorViews, schedule: BoxSchedule) -> None:
        self.scene, self.views = scene, views
        self.steps, self.checkpoint_every, self.seed = (
            schedule.steps,
            schedule.checkpoint_every,
            schedule.seed,
        )
        self.order = ViewOrder(len(views.cameras), len(views.sweeps), 1, schedule.seed)

    def parameter_groups(self) -> list[ParameterGroup]:
        scene = self.scene
        return [ParameterGroup("looks", [scene.ground, scene.actors, scene.sky], Rate(0.1))]

    def losses(self, step: int, generator: torch.Generator) -> StepLosses:
        kind, number = self.order.at(step)
        scene = self.scene
        if kind == "image":
            view = self.views.cameras[number]
            assert view.image is not None
            loss = (scene.camera(scene.graph, view).rgb - view.image / 255).abs().mean()
        else:
            sweep = self.views.sweeps[number]
            rendered = scene.sweep(scene.graph, scene.prepare_sweep(sweep), sweep.t_s)
            loss = intensity_loss(rendered.intensity, sweep.beams.intensity, sweep.beams.returned)
        return StepLosses(f"{kind} {number}", {"loss": loss})

    def evolve(self, step: int, optimizer: Optimizer, generator: torch.Generator) -> None:
        with torch.no_grad():
            self.scene.ground.clamp_(0, 1)


@dataclass(frozen=True)
class BoxRecipe:
    schedule: BoxSchedule
    kind: Literal["boxes"] = "boxes"

    def begin(self, views: SensorViews, tracks: ActorTracks, cameras: int, reach_m: float) -> BoxScene:
        return BoxScene(tracks, cameras, reach_m)

    def open(self, weights: Path, reach_m: float) -> BoxScene:
        saved = load_file(weights)
        return BoxScene(saved_tracks(saved), len(saved["camera_late_s"]), reach_m)

    def training(self, scene: Any, views: SensorViews, tower: object = None) -> BoxTraining:
        return BoxTraining(scene, views, self.schedule)

    def complete(self, scene: Any, T_scene_ego: Float[Tensor, "K 4 4"], views: SensorViews) -> None:
        pass

    def learning_gib(self, pixels: int) -> float:
        return 0.01


RECIPE = ReconstructionRecipe(
    "boxes", image_hw=(48, 96), representation=BoxRecipe(BoxSchedule()), moves_m=0.0
)


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(reconstruction.REPRESENTATIONS, "boxes", BoxRecipe)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    (log,) = find_logs(world.write(tmp_path_factory.mktemp("boxes"), frames=7))
    return log


@pytest.fixture
def run(log: LogPath, tmp_path: Path) -> Reconstruction:
    return reconstruct(RECIPE, log, tmp_path / "run")


def test_it_is_reconstructed_and_evaluated(run: Reconstruction) -> None:
    """Its geometry is exact, so that colours alone are learned: red, green and the ground's grey."""
    found = {name: value for name, value in run.summary.items() if isinstance(value, float)}
    assert run.summary["boxes"] == 2
    assert found["psnr_db"] > 20
    assert found["drop_accuracy"] > 0.95
    assert found["depth_median_sq_m2"] < 1e-4
    assert (run.folder / "static.ply").is_file()


def test_it_goes_on_and_opens(run: Reconstruction, log: LogPath) -> None:
    opened = open_reconstruction(run.folder).scene
    view = run.held_out.cameras[0]
    assert isinstance(opened, BoxScene)
    assert torch.equal(opened.camera(opened.graph, view).rgb, run.scene.camera(run.scene.graph, view).rgb)
    again = reconstruct(RECIPE, log, run.folder).scene
    assert torch.equal(again.content.preview(STATIC).feature, opened.content.preview(STATIC).feature)


@torch.no_grad()
def test_edits_know_nothing_of_it(run: Reconstruction) -> None:
    """A copy of the parked red box is sent into the view, the original goes."""
    scene, vehicle = run.scene, open_reconstruction(run.folder).vehicle
    sent = DriveStraight(7, copy=9, at_m=(9.0, 0.0, 1.0), at_s=0.2)
    edits = [sent, Duplicate(11, copy=12, offset_m=(30.0, 0.0, 0.0)), Remove(7)]
    graph = apply_edits(scene.graph, edits).graph
    assert graph.tracks.track_id.tolist() == [11, 9, 12]
    view = novel_camera_view(vehicle.rig, 0, vehicle.at(0.2))
    centre = scene.camera(graph, view).rgb[:, 24:30, 44:52].mean((1, 2))
    assert centre.tolist() == pytest.approx(scene.actors[0, :3].tolist(), abs=1e-5)
    assert centre[0] > centre[1] + 0.1
    before = scene.camera(scene.graph, view).rgb[:, 24:30, 44:52].mean((1, 2))
    assert abs(float(before[0] - before[1])) < 0.1


def test_actors_of_another_representation_are_refused(run: Reconstruction) -> None:
    content = GaussianContent(run.scene.content.preview(0), torch.zeros(1, dtype=torch.int64))
    gaussians = SceneGraph(run.scene.tracks, content)
    with pytest.raises(InputError, match="actor 7 cannot be copied here: an actor that is not a box"):
        apply_edits(run.scene.graph, [Insert("other", 7, 30, 11)], lambda _: gaussians)
    assert edited_scene(run.scene, [Insert(str(run.folder), 7, 30, 11)]).graph.tracks.track_id[-1] == 30


def test_the_verbs_know_nothing_of_it(run: Reconstruction, tmp_path: Path) -> None:
    film = tmp_path / "film.webp"
    assert main(["render", str(run.folder), "--out", str(film), "--remove", "7", "--seconds", "0.2"]) == 0
    assert film.stat().st_size > 0
