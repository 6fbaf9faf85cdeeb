"""Runs opened again without their logs, and actors that go from one to another."""

from pathlib import Path

import pytest
import synthetic_log as world
import torch

from foredrive.data import find_logs
from foredrive.errors import InputError
from foredrive.recipes.gaussians import RebuildRecipe
from foredrive.recipes.rebuilt_runs import edited_scene, open_scene
from foredrive.recipes.reconstruct import Rebuilt, reconstruct
from foredrive.rendering.edits import Insert, Remove
from foredrive.rendering.initial import InitialSize
from foredrive.training.rebuilding import RebuildSchedule

SMALLEST = RebuildRecipe(
    name="smallest",
    image_hw=(24, 48),
    initial=InitialSize(lidar_points=1500, pixel_points=1000, near_points=0, actor_points=80, features=2),
    schedule=RebuildSchedule(steps=2, most_gaussians=3000, beam_stride=4),
    cameras=("ahead",),
    decoder_width=8,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Rebuilt:
    folder = tmp_path_factory.mktemp("opened")
    (log,) = find_logs(world.write(folder, frames=5))
    return reconstruct(SMALLEST, log, folder / "run")


@torch.no_grad()
def test_an_opened_scene_shows_the_same(run: Rebuilt) -> None:
    scene = open_scene(run.folder)
    view = run.held_out.cameras[0]
    assert torch.equal(scene(scene.graph, view).rgb, run.scene(run.scene.graph, view).rgb)


@torch.no_grad()
def test_an_actor_of_another_run_is_where_one_of_this_was(run: Rebuilt) -> None:
    edits = [Insert(str(run.folder), actor=7, copy=70, follows=11), Remove(11)]
    edited = edited_scene(run.scene, edits)
    assert edited.graph.tracks.track_id.tolist() == [7, 70]
    view = run.held_out.cameras[0]
    before, after = (run.scene(graph, view).rgb for graph in (run.scene.graph, edited.graph))
    changed = (before - after).abs().amax(0) > 0.02
    assert 0 < float(changed.float().mean()) < 0.5  # the moving box, and nothing else
    assert float(changed[:, :24].float().mean()) < 0.02  # it is to the right


def test_what_is_no_finished_run_is_told(run: Rebuilt, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not the folder of a reconstruction"):
        open_scene(tmp_path)
    (tmp_path / "config.yaml").write_bytes((run.folder / "config.yaml").read_bytes())
    with pytest.raises(InputError, match="not finished"):
        open_scene(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match="not the weights of a scene"):
        open_scene(tmp_path)
