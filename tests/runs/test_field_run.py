"""A log reconstructed as a neural field: trained, resumed to the same bits, opened, edited, rendered."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor

from foredrive.cli.main import main
from foredrive.data import LogPath, find_logs
from foredrive.engine import loop
from foredrive.engine.learning_rates import Rate
from foredrive.errors import InputError
from foredrive.methods.neurad.config import FieldConfig, GridConfig, GridsConfig
from foredrive.methods.neurad.decoders import PatchDecoderConfig
from foredrive.methods.neurad.rays import FieldRays
from foredrive.methods.neurad.recipes import FieldRecipe, padded_scale_m, tiny_field
from foredrive.methods.neurad.scene import FieldScene, FieldSceneConfig, field_of
from foredrive.methods.neurad.training import FieldTraining
from foredrive.methods.reconstruction.edits import Duplicate, Insert, Move, Remove, apply_edits
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.training import SensorViews, make_optimizer
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.initial import AHEAD_LEFT_UP
from foredrive.runs.recipes.reconstruction import (
    ReconstructionRecipe,
    field_base,
    field_tiny,
    rescheduled_recipe,
)
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct, shipped_tower
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.reconstruction.trust import expected_psnr_db, trust_of
from foredrive.view.reconstruction_viewer import ReconstructedViewer

STEPS = 6


def recipe(steps: int = STEPS) -> ReconstructionRecipe[FieldRecipe]:
    actors = GridConfig(levels=2, features=1, coarsest=8, finest=32, log2_rows=10)
    small = GridsConfig(GridConfig(levels=3, features=1, coarsest=8, finest=64, log2_rows=12), actors)
    schedule = dataclasses.replace(
        tiny_field().schedule, steps=steps, patch=8, beams=64, checkpoint_every=3, free_m=50.0
    )
    rates = dataclasses.replace(schedule.rates, camera_offset=Rate(1e-4), actor_offset=Rate(1e-3))
    return ReconstructionRecipe(
        name="small_field",
        image_hw=(48, 96),
        moves_m=0.0,
        representation=FieldRecipe(
            schedule=dataclasses.replace(schedule, rates=rates),
            scene=FieldSceneConfig(
                network=FieldConfig(
                    small, (small,), proposal_samples=(12,), samples=8, width=8, scale_m=20.0, appearance=2
                ),
                decoder=PatchDecoderConfig(8, 8, 3, 1, 1, batch_norm=True),
            ),
        ),
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    (log,) = find_logs(world.write(tmp_path_factory.mktemp("field"), frames=7))
    return log


@pytest.fixture(scope="module")
def run(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Reconstruction:
    return reconstruct(recipe(), log, tmp_path_factory.mktemp("run") / "run")


def image(scene: FieldScene, graph: SceneGraph, run: Reconstruction) -> Tensor:
    with torch.no_grad():
        return scene.camera(graph, run.held_out.cameras[0]).rgb


def test_it_is_trained_evaluated_and_opens_as_it_was(run: Reconstruction) -> None:
    scene = run.scene
    assert isinstance(scene, FieldScene)
    assert run.summary["grid entries"] == scene.sizes["grid entries"] > 1000
    for name in ("psnr_db", "depth_median_sq_m2", "drop_accuracy"):
        assert isinstance(run.summary[name], float)
    assert bool(scene.actor_offset.any())
    assert bool(scene.camera_offset.any())
    assert image(scene, scene.graph, run).shape == (3, 48, 96)
    opened = open_reconstruction(run.folder).scene
    assert isinstance(opened, FieldScene)
    assert torch.equal(image(opened, opened.graph, run), image(scene, scene.graph, run))


def test_an_interrupted_run_goes_on_to_the_same_bits(
    run: Reconstruction, log: LogPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped at its first checkpoint, after three of six steps."""
    save = loop.save_checkpoint

    def save_and_stop(*args, **kwargs):  # type: ignore[no-untyped-def]
        save(*args, **kwargs)
        if args[-1] == 3:
            raise KeyboardInterrupt

    folder = tmp_path / "halves"
    with monkeypatch.context() as patched:
        patched.setattr(loop, "save_checkpoint", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            reconstruct(recipe(), log, folder)
    halves, whole = reconstruct(recipe(), log, folder).scene.state_dict(), run.scene.state_dict()
    assert [name for name in whole if not torch.equal(whole[name], halves[name])] == []


def test_the_depth_of_an_image_is_along_the_axis_of_a_camera_that_turns(run: Reconstruction) -> None:
    """The camera turns by 0.4 rad while the image is read out: each row has its own axis."""
    scene, view = run.scene, run.held_out.cameras[0]
    assert isinstance(scene, FieldScene)
    twist = torch.tensor([0.0, 0, 0, 0, 4, 0])
    view = dataclasses.replace(view, twist_cam=twist, readout_s=0.1, dist=torch.zeros(5))
    (height, width), corner = view.size_hw, torch.zeros(2, dtype=torch.int64)
    with torch.no_grad():
        image = scene.camera(scene.graph, view)
        rays = scene.rays_of_pixels(view, corner, torch.tensor([width // 3, height // 3]))
        seen = scene.look(scene.graph, rays)
    middle = torch.tensor([[3 * u + 1.5, 3 * v + 1.5] for v in range(height // 3) for u in range(width // 3)])
    x, y = ((middle - view.K[:2, 2]) / view.K.diagonal()[:2]).unbind(-1)
    expected = seen.depth_m / seen.alpha / (1 + x * x + y * y).sqrt()
    torch.testing.assert_close(image.range_m[1::3, 1::3].flatten(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("log_opacity", [-20.0, -200.0])
def test_beams_that_end_in_the_sky_do_not_return_from_the_sensor(
    run: Reconstruction, log_opacity: float
) -> None:
    """Almost nothing, then nothing at all stops the beams, and the decoder takes all of them to return."""
    scene = open_reconstruction(run.folder).scene
    assert isinstance(scene, FieldScene)
    geometry, last = scene.field.layers.geometry.linear[-1], scene.lidar_decoder.net[-1]
    assert isinstance(geometry, torch.nn.Linear)
    assert isinstance(last, torch.nn.Linear)
    with torch.no_grad():
        geometry.weight[0], last.weight[1], last.bias[1] = 0, 0, -5
        scene.field.layers.beta = torch.nn.Parameter(torch.tensor(1.0))
        geometry.bias[0] = -log_opacity
        sweep = run.held_out.sweeps[0]
        seen = scene.sweep(scene.graph, scene.prepare_sweep(sweep), sweep.t_s)
    assert not bool(seen.returned.any())
    assert bool(seen.range_m.isfinite().all())
    if log_opacity == -20:
        assert seen.range_m.min() > 5  # not at the sensor


def test_what_stands_belongs_to_the_static_grid(log: LogPath, tmp_path: Path) -> None:
    """A ray to the box that stands crosses no box; one to the box that moves crosses its own."""
    reconstructed = reconstruct(dataclasses.replace(recipe(steps=1), moves_m=0.5), log, tmp_path / "run")
    scene = open_reconstruction(reconstructed.folder).scene
    assert isinstance(scene, FieldScene)
    assert scene.graph.tracks.track_id.tolist() == [11]
    assert scene.graph.all_tracks.track_id.tolist() == [11, 7]
    targets = torch.from_numpy(np.stack([box["centre"] for box in (world.PARKED, world.MOVING)])).float()
    rays = FieldRays(torch.zeros(2, 3), F.normalize(targets, dim=-1), torch.zeros(2), torch.ones(2))
    crossings = scene.field.crossings(rays, scene.graph.tracks)
    assert (crossings.ray.tolist(), crossings.box.tolist()) == ([1], [0])


def test_edits_move_places_and_never_weights(run: Reconstruction) -> None:
    scene = run.scene
    before = {name: value.clone() for name, value in scene.state_dict().items()}
    graph = apply_edits(scene.graph, [Duplicate(7, copy=9, offset_m=(3.0, 0.0, 0.0)), Remove(11)]).graph
    content = field_of(graph)
    assert graph.tracks.track_id.tolist() == [7, 9]
    assert content.slot.tolist() == [scene.tracks.index_of(7)] * 2
    assert content.evidence(0) == content.evidence(1) > 0
    assert len(content.preview(STATIC).mean_m) > 100
    assert not torch.equal(image(scene, graph, run), image(scene, scene.graph, run))
    moved = apply_edits(scene.graph, [Move(7, (0.0, 0.0, 0.0))]).graph
    assert torch.allclose(image(scene, moved, run), image(scene, scene.graph, run), atol=1e-5)
    after = scene.state_dict()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


def test_actors_of_gaussians_and_of_other_fields_are_refused_and_one_of_this_field_opened_again_is_its_own(
    run: Reconstruction, log: LogPath, tmp_path: Path
) -> None:
    scene = run.scene
    gaussians = GaussianContent(scene.content.preview(0), torch.zeros(1, dtype=torch.int64))
    other = SceneGraph(scene.tracks, gaussians)
    insert = Insert("other", 7, 30, 11)
    with pytest.raises(
        InputError, match="actor 7 cannot be copied here: an actor that is not part of a field"
    ):
        apply_edits(scene.graph, [insert], lambda _: other)
    again = open_reconstruction(run.folder).scene
    same = field_of(apply_edits(scene.graph, [insert], lambda _: again.graph).graph)
    assert same.slot.tolist()[-1] == scene.tracks.index_of(7)
    other_field = reconstruct(rescheduled_recipe(recipe(1), seed=1), log, tmp_path / "run").scene
    with pytest.raises(InputError, match="another neural field does not fit"):
        apply_edits(scene.graph, [insert], lambda _: other_field.graph)


def test_all_beams_return_where_a_log_does_not_tell_which_are_lost(run: Reconstruction) -> None:
    """Steps of training that learn brightness, and nothing of lost beams."""
    views = SensorViews([], [dataclasses.replace(view, misses_known=False) for view in run.train.sweeps])
    representation = recipe().representation
    scene = representation.begin(views, run.scene.tracks.map_tensors(Tensor.detach), 2, 200.0)
    training = FieldTraining(scene, views, representation.schedule)
    optimizer, before = make_optimizer(training), scene.lidar_decoder.net[-1].bias.clone()  # type: ignore[operator]
    for step in range(3):
        losses = training.losses(step, torch.Generator().manual_seed(step)).losses
        assert "drop" not in losses
        optimizer.zero_grad()
        losses["loss"].backward()
        for group in optimizer.param_groups:
            group["lr"] = 1e-2
        optimizer.step()
    after = scene.lidar_decoder.net[-1].bias
    assert after[0] != before[0]
    assert after[1] == before[1]
    view = views.sweeps[0]
    with torch.no_grad():
        seen = scene.sweep(scene.graph, scene.prepare_sweep(view), view.t_s)
    stopped = (seen.alpha > 1e-3) & (seen.hit_range_m < 200)
    assert bool(stopped.any())
    assert bool(seen.returned[stopped].all())


def test_a_perceptual_loss_where_there_are_weights(run: Reconstruction, tmp_path: Path) -> None:
    """Equal images have none, others have some; the network is not a part of the scene."""
    rng, state = torch.Generator().manual_seed(0), {}
    widths = [3, 64, 64, 128, 128, *[256] * 4, *[512] * 5]
    for layer, source, target in zip(
        [0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28], widths[:-1], widths[1:], strict=True
    ):
        state[f"features.{layer}.weight"] = torch.randn(target, source, 3, 3, generator=rng) * 0.05
        state[f"features.{layer}.bias"] = torch.zeros(target)
    save_file(state, tmp_path / "vgg.safetensors")
    schedule, scene = recipe().representation.schedule, run.scene
    assert isinstance(scene, FieldScene)
    names = set(scene.state_dict())
    seen = dataclasses.replace(schedule, perceptual=str(tmp_path / "vgg.safetensors"))
    losses = FieldTraining(scene, run.train, seen).losses(0, torch.Generator().manual_seed(0)).losses
    plain = FieldTraining(scene, run.train, schedule).losses(0, torch.Generator().manual_seed(0)).losses
    assert losses["perceptual"] > 0
    assert "perceptual" not in plain
    torch.testing.assert_close(losses["loss"], plain["loss"] + 0.05 * losses["perceptual"])
    assert set(scene.state_dict()) == names
    with pytest.raises(InputError, match="no such file of VGG-19 weights"):
        FieldTraining(scene, run.train, dataclasses.replace(schedule, perceptual="missing.pth"))


def test_a_perceptual_loss_of_the_shipped_tower(run: Reconstruction) -> None:
    """LPIPS's distance, between 0 and 4, whose gradient reaches the field."""
    scene = run.scene
    assert isinstance(scene, FieldScene)
    schedule = dataclasses.replace(run.recipe.representation.schedule, perceptual="tower")
    training = run.recipe.representation.training(scene, run.train, lambda: shipped_tower().features)
    assert "perceptual" not in training.losses(0, torch.Generator().manual_seed(0)).losses
    training = FieldTraining(scene, run.train, schedule, lambda: shipped_tower().features)
    losses = training.losses(0, torch.Generator().manual_seed(0)).losses
    assert 0 < float(losses["perceptual"].detach()) < 4
    (gradient,) = torch.autograd.grad(losses["perceptual"], next(scene.camera_decoder.parameters()))
    assert bool(gradient.any())
    with pytest.raises(InputError, match="no image tower here"):
        FieldTraining(scene, run.train, schedule)


def test_a_film_of_it_without_an_actor(run: Reconstruction, tmp_path: Path) -> None:
    film = tmp_path / "film.webp"
    assert main(["render", str(run.folder), "--out", str(film), "--remove", "7", "--seconds", "0.2"]) == 0
    assert film.stat().st_size > 0


def test_a_page_says_that_the_browser_draws_lidar_points(run: Reconstruction, tmp_path: Path) -> None:
    page = ReconstructedViewer(
        open_reconstruction(run.folder), [Remove(7)], tmp_path / "edits.json", "localhost", 0
    )
    try:
        assert page.layers["splats"].label == "coloured lidar points"
        assert "the browser draws coloured lidar points" in page._note.content
        page.jobs.wait()
        assert page.pictures.images[0].image.max() > 0
    finally:
        page.close()


def test_the_choices_of_the_reference_are_trained_and_open_as_they_were(log: LogPath, tmp_path: Path) -> None:
    """Ranges that are not divided by alpha, no biases, bounds from the path, padded proposals."""
    small, published = recipe(steps=3), field_base().representation.scene
    network = dataclasses.replace(
        small.representation.scene.network,
        **{name: getattr(published.network, name) for name in ("resampling", "scale_m", "biases", "surface")},
    )
    scene_config = dataclasses.replace(small.representation.scene, network=network, whole_ranges=False)
    representation = dataclasses.replace(small.representation, scene=scene_config)
    reconstructed = reconstruct(
        dataclasses.replace(small, representation=representation), log, tmp_path / "run"
    )
    scene, opened = reconstructed.scene, open_reconstruction(reconstructed.folder).scene
    assert isinstance(scene, FieldScene)
    assert isinstance(opened, FieldScene)
    assert [name for name, _ in scene.field.named_parameters() if "bias" in name] == []
    # The first frame is 1.5 m behind the middle of the 3 m, cameras and lidar are 0.8 m further on average.
    assert float(opened.field.scale_m) == pytest.approx(80 + 1.5 + 0.8, abs=0.01)
    assert opened.field.grids.scale_m == pytest.approx(float(scene.field.scale_m))
    assert torch.equal(image(opened, opened.graph, reconstructed), image(scene, scene.graph, reconstructed))
    view = reconstructed.held_out.sweeps[0]
    with torch.no_grad():
        plain = scene.sweep(scene.graph, scene.prepare_sweep(view), view.t_s)
        scene.config = dataclasses.replace(scene.config, whole_ranges=True)
        whole = scene.sweep(scene.graph, scene.prepare_sweep(view), view.t_s)
    assert bool((plain.alpha < 0.999).all())  # with no biases, each sample stops about half
    torch.testing.assert_close(plain.range_m, whole.range_m * plain.alpha)


def test_bounds_hold_the_surroundings_of_all_poses(run: Reconstruction) -> None:
    """One sweep at the origin looks along x, one at x = 100 m along y: from x = -80 m to 160 m."""
    turned = torch.eye(4)
    turned[:2, :2], turned[0, 3] = torch.tensor([[0.0, -1], [1, 0]]), 100.0
    sweeps = [dataclasses.replace(run.train.sweeps[0], T_scene_ego=T) for T in (torch.eye(4), turned)]
    found_m = padded_scale_m(SensorViews([], sweeps), torch.tensor([50.0, 0, 0]))
    assert found_m == pytest.approx(130.0)  # behind the first; 110 m beside the second
    camera = dataclasses.replace(run.train.cameras[0], T_scene_cam=turned @ AHEAD_LEFT_UP.inverse())
    assert padded_scale_m(SensorViews([camera], []), torch.zeros(3)) == pytest.approx(160.0)


def test_appearance_codes_learn_as_fast_as_layers(run: Reconstruction) -> None:
    assert isinstance(run.scene, FieldScene)
    training = FieldTraining(run.scene, run.train, recipe().representation.schedule)
    groups = {group.name: {id(p) for p in group.parameters} for group in training.parameter_groups()}
    decoder = run.scene.camera_decoder
    assert {id(decoder.appearance), id(run.scene.lidar_decoder.appearance)} <= groups["layers"]
    assert groups["decoder"] == {id(p) for p in decoder.parameters()} - {id(decoder.appearance)}
    every = [id(p) for group in training.parameter_groups() for p in group.parameters]
    assert sorted(every) == sorted(id(p) for p in run.scene.parameters())


def test_the_sizes_of_neurad() -> None:
    """Table of parameters of the reference implementation: 8 levels of 4 features in 2^22 rows."""
    sizes = field_base().representation.scene.network
    assert (sizes.grids.static.levels, sizes.grids.static.features, sizes.grids.static.log2_rows) == (
        8,
        4,
        22,
    )
    assert sizes.proposal_samples == (128, 64)
    assert field_base().representation.learning_gib(1080 * 1920) > 8
    assert field_tiny().representation.learning_gib(270 * 480) < 2


def test_wrong_settings_and_a_log_of_which_a_step_sees_nothing_are_refused(
    run: Reconstruction, log: LogPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["reconstruct", str(log.folder), "--out", str(tmp_path / "run"), "--recipe", "field_tiny"]
    wrong = "representation.scene.network.proposal_samples=[32, 16]"
    assert main([*command, "--set", wrong]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "representation.scene.network: " in line
    assert "1 proposals and 2 numbers of proposal_samples" in line
    schedule = recipe().representation.schedule
    with pytest.raises(ValueError, match="a step needs patches, or beams of sweeps"):
        dataclasses.replace(schedule, patches=0, sweeps=0)
    no_beams = dataclasses.replace(run.train.sweeps[0], beams=run.train.sweeps[0].beams[:0])
    assert isinstance(run.scene, FieldScene)
    with pytest.raises(InputError, match="nothing to learn from"):
        FieldTraining(run.scene, SensorViews([], [no_beams]), schedule)
    tiny = dataclasses.replace(run.train.cameras[0], size_hw=(2, 96))
    with pytest.raises(InputError, match="need 3 pixels a side"):
        FieldTraining(run.scene, SensorViews([tiny], []), schedule)
    beside = FieldTraining(run.scene, SensorViews([], [no_beams, run.train.sweeps[0]]), schedule)
    assert bool(beside.losses(0, torch.Generator().manual_seed(0)).losses["loss"].isfinite())


def test_the_method_names_the_recipe(
    log: LogPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = ["reconstruct", str(log.folder), "--out", str(tmp_path / "run"), "--recipe", "field_tiny"]
    assert main([*wrong, "--method", "gaussians"]) == 2
    assert (
        "--method gaussians does not go with the recipe field_tiny, which is field" in capsys.readouterr().err
    )


def test_trust_says_where_it_says_little(run: Reconstruction, caplog: pytest.LogCaptureFixture) -> None:
    """After six steps a field is fog, in which nothing was seen again."""
    opened = open_reconstruction(run.folder)
    trust = trust_of(opened)
    (warning,) = caplog.messages
    assert warning.endswith(f"of the held-out images, which have {run.summary['psnr_db']:.1f} dB")
    assert math.isfinite(expected_psnr_db(trust, opened.vehicle, opened.vehicle.at(0.2)))
