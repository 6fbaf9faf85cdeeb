"""The real-to-sim gap of a miniature run on a small reconstructed log."""

import dataclasses
from pathlib import Path

import pytest
import torch
from builders import SMALLEST

from foredrive.cli.main import main
from foredrive.data import ClipDataset, LogPath
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs import Run
from foredrive.runs.evaluate.real_to_sim_gap import RealToSimComparison, measure_gap, rendered_images
from foredrive.runs.reconstruction.reconstruct import read_reconstruction_data, reconstruct
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.scene import Clip, Trajectory
from foredrive.tasks.predictor import Prediction

RECIPE = dataclasses.replace(SMALLEST, hold_out_every=4)


@pytest.fixture(scope="module")
def reconstructed(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gap") / "reconstructed"
    reconstruct(RECIPE, log, folder)
    return folder


def test_what_is_rendered_are_the_moments_of_the_clip(
    trained: Run, log: LogPath, reconstructed: Path
) -> None:
    """Rendered images are nearer to the clip's own than to those of other times; later frames are left."""
    config = dataclasses.replace(trained.recipe.clips, image_hw=RECIPE.image_hw)
    dataset = ClipDataset([log], config, None)
    data = read_reconstruction_data(RECIPE, log, reconstructed / "cache")
    views = [*data.train.cameras, *data.held_out.cameras]
    clip = dataset.clip(0)
    shown = rendered_images(open_reconstruction(reconstructed).scene, clip, 0.5, views, [0, 1])
    assert not torch.equal(shown.images[: clip.now + 1], clip.images[: clip.now + 1])
    assert torch.equal(shown.images[clip.now + 1 :], clip.images[clip.now + 1 :])
    off = (shown.images[:2].float() - clip.images[:2].float()).abs().mean((2, 3, 4))
    swapped = (shown.images[:2].flip(1).float() - clip.images[:2].float()).abs().mean((2, 3, 4))
    assert bool((off < swapped).all())
    with pytest.raises(InputError, match="no view of ahead at"):
        rendered_images(open_reconstruction(reconstructed).scene, clip, 0.53, views, [0, 1])


def test_the_gap_has_both_fits_and_the_agreement(trained: Run, reconstructed: Path, tmp_path: Path) -> None:
    ticks: list[tuple[int, int]] = []
    figures = measure_gap(trained, reconstructed, tmp_path, lambda done, of: ticks.append((done, of)))
    moments = figures["moments"]
    assert ticks[-1] == (moments, moments)
    assert moments == 4  # every fourth frame of 5.1 s, half a second before them and three after
    for name in ("real", "rendered"):
        assert 0 <= float(figures[f"{name}.occupancy.iou_now"]) <= 1
        assert float(figures[f"{name}.planning.uniad.l2_avg_m"]) > 0
    assert float(figures["agreement.planning.uniad.l2_avg_m"]) < 5
    assert 10 < float(figures["psnr_db"]) < 40
    assert read_summary(tmp_path / "gap.json")["moments"] == moments


class Told:
    """Says one thing of bright images and another of dark ones."""

    def predict(self, observed: Clip, asked: object) -> Prediction:
        bright = float(observed.images[0, -1].float().mean()) > 100
        occupied = torch.full((1, 1, 2, 16, 16), -1.0)
        occupied[..., : 8 if bright else 4] = 1.0
        steps = torch.arange(1.0, 7.0)
        xy = torch.stack([steps, torch.full_like(steps, 0.0 if bright else 2.0)], dim=-1)[None, None]
        flat = torch.zeros(1, 1, 6)
        plan = Trajectory(xy, flat, torch.ones_like(flat, dtype=torch.bool), torch.zeros(1, 1), 0.5)
        return Prediction(occupancy_logit=occupied, plan=plan)


def test_agreement_is_of_what_is_said_of_both(trained: Run, log: LogPath) -> None:
    """Of sixteen columns eight are occupied by real images and four of these by rendered ones; plans are 2 m
    apart."""
    config = dataclasses.replace(trained.recipe.clips, future_frames=6)
    example = ClipDataset([log], config, None)[0]
    bright = dataclasses.replace(example.clip, images=torch.full_like(example.clip.images, 200))
    dark = dataclasses.replace(example.clip, images=torch.full_like(example.clip.images, 10))
    seen = RealToSimComparison(Told(), config.image_hw)
    seen.add(dataclasses.replace(example, clip=bright), dark)
    figures = seen.figures(0.5)
    assert figures["agreement.occupancy.iou_now"] == pytest.approx(0.5)
    assert figures["agreement.planning.uniad.l2_3s_m"] == pytest.approx(2.0)
    assert figures["real.planning.uniad.l2_1s_m"] != figures["rendered.planning.uniad.l2_1s_m"]


def test_the_verb_shows_a_table(
    trained: Run, reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(trained.folder), "--in", str(reconstructed), "--out", str(tmp_path)]) == 0
    assert "agreement of both" in capsys.readouterr().out
