"""A log is reconstructed in seconds: whole, interrupted, and without what logs may lack."""

import dataclasses
import json
import logging
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from plyfile import PlyData
from safetensors.torch import load_file, save_file

from foredrive.cli.main import main
from foredrive.data import LogPath, find_logs
from foredrive.engine import loop
from foredrive.engine.config import save_recipe
from foredrive.engine.learning_rates import Rate
from foredrive.errors import InputError
from foredrive.methods.blocks.inception import InceptionFeatures
from foredrive.methods.reconstruction.evaluation import actor_pixels, evaluate_cameras, evaluate_sweeps
from foredrive.methods.reconstruction.perceptual import PerceptualMetrics, PerceptualWeights
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.splatad.initial import InitialGaussians
from foredrive.methods.splatad.rates import LearningRates
from foredrive.methods.splatad.recipes import GaussianRecipe
from foredrive.methods.splatad.training import GaussianSchedule
from foredrive.runs.recipes.known import find_recipe
from foredrive.runs.recipes.reconstruction import (
    ReconstructionRecipe,
    gaussians_base,
    gaussians_published,
    gaussians_tiny,
    load_reconstruction_recipe,
    rescheduled_recipe,
)
from foredrive.runs.reconstruction.reconstruct import (
    initial_model,
    memory_needed_gib,
    read_reconstruction_data,
    reconstruct,
)
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction

STEPS = 40


def recipe(steps: int = STEPS) -> ReconstructionRecipe[GaussianRecipe]:
    return ReconstructionRecipe(
        name="smallest",
        image_hw=(24, 48),
        representation=GaussianRecipe(
            initial=InitialGaussians(
                lidar_points=1100,
                unseen_points=400,
                pixel_points=300,
                near_points=0,
                actor_points=50,
                max_actor_points=100,
                features=2,
                scale=0.7,
            ),
            schedule=GaussianSchedule(
                steps=steps,
                max_gaussians=2200,
                rates=LearningRates(mean_m=Rate(1e-3, final=0.01), albedo=Rate(1e-2)),
                images_per_sweep=2,
                beam_stride=2,
                shrink_steps=(10,),
                grow_from=10,
                grow_until=30,
                grow_every=10,
                checkpoint_every=20,
            ),
        ),
        cameras=("ahead",),
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    (log,) = find_logs(world.write(tmp_path_factory.mktemp("reconstructed"), frames=9))
    return log


@pytest.fixture(scope="module")
def run(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    reconstruct(recipe(), log, folder)
    return folder


def test_held_out_frames_are_shown_better_than_before_learning(run: Path, log: LogPath) -> None:
    summary = reconstruct(recipe(), log, run).summary  # is there already
    assert summary["images"] == summary["sweeps"] == 4
    assert (summary["actors"], summary["obstacles"]) == (1, 1)  # one box moves, one stands
    assert summary["gaussians"] > 2200  # those that learning may make, and ground without observations
    data = read_reconstruction_data(recipe(), log, run / "cache")
    scene = initial_model(recipe(), data)
    before = evaluate_cameras(scene, data.held_out.cameras, data.train.cameras)
    before |= evaluate_sweeps(scene, data.held_out.sweeps)
    after = {name: value for name, value in summary.items() if isinstance(value, float)}
    assert after["psnr_db"] > before["psnr_db"] + 2
    assert after["ssim"] > before["ssim"]
    assert after["intensity_rmse"] < before["intensity_rmse"]
    assert after["drop_accuracy"] > before["drop_accuracy"]
    assert after["depth_median_sq_m2"] < 2.0
    assert after["moving.psnr_db"] == pytest.approx(after["psnr_db"])  # it drives all the time


def test_vehicles_have_a_psnr_of_their_own_over_all_images_together(run: Path, log: LogPath) -> None:
    done = reconstruct(recipe(), log, run)
    squared = []
    for view in done.held_out.cameras:
        assert view.image is not None
        with torch.no_grad():
            rgb = done.scene.camera(done.scene.graph, view).rgb.clamp(0, 1)
        where = actor_pixels(done.scene.tracks, view)
        assert 0 < int(where.sum()) < where.numel()
        squared.append((rgb - view.image / 255).square()[:, where].flatten())
    mean = float(torch.cat(squared).mean())
    assert done.summary["vehicles.psnr_db"] == pytest.approx(-10 * math.log10(mean), abs=1e-3)
    assert "people.psnr_db" not in done.summary


def test_an_interrupted_run_comes_to_the_same(
    run: Path, log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped after the first checkpoint, when Gaussians have been added and moved."""

    save = loop.save_checkpoint

    def save_and_stop(*args, **kwargs):  # type: ignore[no-untyped-def]
        save(*args, **kwargs)
        if args[-1] == 20:
            raise KeyboardInterrupt

    folder = tmp_path / "halves"
    with monkeypatch.context() as patched:
        patched.setattr(loop, "save_checkpoint", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(recipe(), log, folder)
    reconstruct(recipe(), log, folder)
    whole, halves = load_file(run / "model.safetensors"), load_file(folder / "model.safetensors")
    assert all(torch.equal(whole[name], halves[name]) for name in whole)


def test_the_recipe_comes_back_from_its_file(run: Path) -> None:
    assert load_reconstruction_recipe(run / "config.yaml") == recipe()


def test_weights_that_are_none_are_told(run: Path, log: LogPath, tmp_path: Path) -> None:
    folder = tmp_path / "damaged"
    shutil.copytree(run, folder, ignore=shutil.ignore_patterns("cache"))
    (folder / "model.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="not the weights of a scene"):
        reconstruct(recipe(), log, folder)


def test_what_stands_is_there_for_other_viewers(run: Path) -> None:
    weights = load_file(run / "model.safetensors")
    static = weights["actor"] == STATIC
    assert 0 < int(static.sum()) < len(static)
    written = PlyData.read(run / "static.ply")["vertex"]
    mean_m = weights["mean_m"][static].numpy()
    kept = np.isin(mean_m[:, 0], written["x"])  # all but those far beyond the others
    assert kept.mean() > 0.9
    assert np.array_equal(np.stack([written[axis] for axis in "xyz"], -1), mean_m[kept])


def test_a_folder_with_another_run_is_refused(run: Path, log: LogPath, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another recipe"):
        reconstruct(recipe(7), log, run)
    (other,) = find_logs(world.write(tmp_path, frames=2, name="other"))
    with pytest.raises(InputError, match="another log"):
        reconstruct(recipe(), other, run)


def test_what_a_log_lacks_is_said(log: LogPath, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Without lidar, without tracks and with one camera there are cameras' figures alone."""
    for name in ("lidar.lidar_top", "custom.lidar_beams", "box_detections_se3"):
        assert list(log.folder.glob(f"{name}*")), name
    folder = tmp_path / "logs" / "flat_train" / "less"
    folder.mkdir(parents=True)
    for file in log.folder.iterdir():
        if not file.name.startswith(("lidar", "custom.lidar", "box_detections")):
            (folder / file.name).write_bytes(file.read_bytes())
    (less,) = find_logs(folder)
    with caplog.at_level(logging.WARNING):
        summary = reconstruct(recipe(4), less, tmp_path / "run").summary
    said = " ".join(record.message for record in caplog.records)
    assert "no lidar" in said
    assert "no tracks" in said
    assert "one camera" in said
    assert "psnr_db" in summary
    assert "drop_accuracy" not in summary
    assert summary["actors"] == 0


def test_too_little_memory_is_said_before(
    log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    huge = rescheduled_recipe(recipe(), max_gaussians=10**12)
    with pytest.raises(InputError, match=r"smallest needs about \d+\.\d GiB .* GiB are free"):
        reconstruct(huge, log, tmp_path / "huge")
    assert not (tmp_path / "huge").exists()


def test_named_recipes() -> None:
    assert find_recipe("gaussians_tiny", (), ReconstructionRecipe) == gaussians_tiny()
    with pytest.raises(InputError, match="near: gaussians_"):
        find_recipe("gaussians_huge", (), ReconstructionRecipe)
    assert memory_needed_gib(gaussians_tiny(), frames=56, cameras=6) < 3
    assert 8 < memory_needed_gib(gaussians_base(), frames=80, cameras=6) < 40


@pytest.mark.slow
def test_metrics_with_networks_are_added_to_a_finished_run(run: Path, log: LogPath, tmp_path: Path) -> None:
    """FID of a set of images and itself is 0; random weights suffice for that."""
    folder, networks = tmp_path / "run", tmp_path / "networks"
    shutil.copytree(run, folder)
    networks.mkdir()
    torch.manual_seed(0)
    save_file(InceptionFeatures().state_dict(), networks / "inception.safetensors")
    metrics = PerceptualMetrics(PerceptualWeights(inception=networks / "inception.safetensors"))
    before = json.loads((folder / "summary.json").read_text())
    found = reconstruct(recipe(), log, folder, None, metrics)
    assert float(found.summary["fid"] or 0) > 0
    assert "lpips" not in found.summary
    assert {name: found.summary[name] for name in before} == before
    cameras = found.held_out.cameras
    shown = []
    for camera in cameras:
        rgb = found.scene.camera(found.scene.graph, camera).rgb.detach().clamp(0, 1)
        shown.append(dataclasses.replace(camera, image=(255 * rgb).round().byte()))
    assert metrics.evaluate(found.scene, shown)["fid"] == pytest.approx(0.0, abs=1e-4)


def test_the_published_recipe_has_the_choices_of_the_reference() -> None:
    chosen = gaussians_published()
    assert memory_needed_gib(chosen, frames=80, cameras=6) < 40
    gaussians = chosen.representation
    initial, scene, rates = gaussians.initial, gaussians.scene, gaussians.schedule.rates
    assert (scene.decoder.blocks, scene.decoder.width, scene.background) == ("residual", 32, "after_decoder")
    assert initial.random_features
    assert initial.random_rotations
    assert (initial.random_far_points, initial.random_near_points) == (300_000, 300_000)
    assert (initial.pixel_points, initial.near_points) == (0, 0)
    kinds = ("mean_m", "quaternion", "log_scale", "opacity_logit", "albedo", "feature", "decoders")
    last = {name: getattr(rates, name).at(30_000, 30_000) / getattr(rates, name).first for name in kinds}
    assert last.pop("mean_m") == pytest.approx(0.01)
    assert set(last.values()) == {1.0}
    actors = rates.actor_offset
    assert [actors.at(step, 30_000) for step in (0, 2_500, 20_001)] == pytest.approx([0, 1e-3, 1e-4])
    assert scene.frame_velocities
    assert (rates.frame_velocity.first, rates.frame_turn.first) == (1e-3, 2e-4)
    assert (rates.camera_twist.first, rates.camera_offset.first, rates.camera_late_s.first) == (0, 0, 2e-4)
    weights = gaussians.schedule.weights
    assert (weights.frame_velocity, weights.frame_turn) == (1e-6, 1e-5)
    assert (scene.camera_near_m, scene.lidar_reach_m, scene.drop_from_alpha) == (0.5, 300.0, False)
    assert gaussians.schedule.lidar_losses == "published"


def test_the_published_recipe_learns_on_few_gaussians(log: LogPath, tmp_path: Path) -> None:
    """Its own settings, with the sizes of a test: built, trained for 12 steps, saved and opened."""
    published, small = gaussians_published(), recipe(12)
    chosen = dataclasses.replace(
        published,
        image_hw=small.image_hw,
        cameras=small.cameras,
        representation=dataclasses.replace(
            published.representation,
            initial=dataclasses.replace(
                published.representation.initial,
                lidar_points=1100,
                unseen_points=400,
                random_far_points=200,
                random_near_points=100,
                features=2,
                max_actor_points=100,
            ),
            schedule=dataclasses.replace(
                published.representation.schedule,
                steps=12,
                max_gaussians=2200,
                beam_stride=2,
                grow_from=2,
                grow_every=5,
            ),
        ),
    )
    data = read_reconstruction_data(chosen, log, tmp_path / "cache")
    before = initial_model(chosen, data)
    frames = len(data.train.cameras) + len(data.train.sweeps)
    assert before.frame_velocity is not None
    assert before.frame_velocity.shape == (frames, 3)
    assert before.reach_m == 300.0
    static = before.content.preview(STATIC).map_tensors(torch.Tensor.detach)
    assert float(static.feature[:, 3:].std()) == pytest.approx(1.0, abs=0.1)
    assert float(static.quaternion.abs().mean(0).std()) < 0.05
    assert int((static.mean_m.norm(dim=-1) > 50).sum()) >= 200
    found = reconstruct(chosen, log, tmp_path / "run", tmp_path / "cache")
    assert np.isfinite(float(found.summary["psnr_db"] or math.nan))
    weights = load_file(tmp_path / "run" / "model.safetensors")
    assert torch.equal(weights["camera_offset"], torch.zeros(1, 6))
    assert torch.equal(weights["camera_twist"], torch.zeros(1, 6))
    assert not torch.equal(weights["frame_velocity"], before.frame_velocity)
    opened, camera = open_reconstruction(tmp_path / "run").scene, data.held_out.cameras[0]
    with torch.no_grad():
        shown, again = (scene.camera(scene.graph, camera).rgb for scene in (opened, found.scene))
    torch.testing.assert_close(shown, again)


def test_a_log_of_one_frame_is_said_not_to_be_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (single,) = find_logs(world.write(tmp_path, frames=1))
    save_recipe(recipe(1), tmp_path / "recipe.yaml")
    line = ["reconstruct", str(single.folder), "--out", str(tmp_path / "run")]
    assert main([*line, "--recipe", str(tmp_path / "recipe.yaml")]) == 0
    assert "no frame was held out, so the scene is not evaluated" in capsys.readouterr().out
    assert "psnr_db" not in json.loads((tmp_path / "run" / "summary.json").read_text())


@pytest.mark.slow
def test_several_logs_have_a_run_each_and_a_bad_one_stops_no_other(
    log: LogPath, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = tmp_path / "data" / "logs" / "flat_train"
    for name in ("bad", "first", "second"):
        shutil.copytree(log.folder, split / name)
    for file in (split / "bad").glob("camera.*.arrow"):
        file.write_bytes(file.read_bytes()[:100])
    save_recipe(recipe(3), tmp_path / "recipe.yaml")
    line = ["reconstruct", str(tmp_path / "data"), "--out", str(tmp_path / "runs"), "--workers", "2"]
    assert main([*line, "--recipe", str(tmp_path / "recipe.yaml")]) == 2
    told = capsys.readouterr()
    assert "1 of 3 logs failed: flat_train/bad (" in told.err
    assert told.out.count("reconstructed flat_train/") == 2
    alone = tmp_path / "alone"
    reconstruct(recipe(3), LogPath(split / "first", tmp_path / "data" / "maps"), alone)
    for name in ("first", "second"):
        folder = tmp_path / "runs" / "flat_train" / name
        assert (folder / "held_out.png").is_file()
        assert (folder / "model.safetensors").read_bytes() == (alone / "model.safetensors").read_bytes()
