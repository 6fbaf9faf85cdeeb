"""The picture of a reconstructed scene, from the command line."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
from PIL import Image

from foredrive.cli.main import main
from foredrive.methods.splatad.initial import InitialGaussians
from foredrive.methods.splatad.recipes import GaussianRecipe
from foredrive.methods.splatad.training import GaussianSchedule
from foredrive.runs.recipes import reconstruction


def test_the_verb_writes_a_picture_and_says_how_good_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    size = InitialGaussians(
        lidar_points=1100, unseen_points=400, pixel_points=1000, near_points=0, actor_points=20, features=2
    )
    smallest = dataclasses.replace(
        reconstruction.gaussians_tiny(),
        image_hw=(24, 48),
        representation=GaussianRecipe(size, GaussianSchedule(steps=3, max_gaussians=3000, beam_stride=4)),
    )
    monkeypatch.setitem(reconstruction.RECONSTRUCTION_RECIPES, "smallest", smallest)
    log = world.write(tmp_path, frames=4)
    out = tmp_path / "run"
    args = ["reconstruct", str(log), "--out", str(out), "--recipe", "smallest", "--cameras", "pcam_f0"]
    assert main(args) == 0
    said = capsys.readouterr().out
    assert "reconstructed flat_train/flat by gaussians" in said
    assert "nearest.psnr_db" in said
    picture = np.asarray(Image.open(out / "held_out.png").convert("RGB"))
    assert picture.shape[1] == 4 * 4 * 120
    # the first column is what was seen: two held-out frames, each with sky above and ground below
    seen = picture[:, : picture.shape[1] // 4].reshape(-1, 3).astype(int)
    for rgb in (world.SKY_RGB, world.GROUND_RGB):
        assert (np.abs(seen - rgb).max(-1) < 8).mean() > 0.1


def test_an_unknown_recipe_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = world.write(tmp_path, frames=2)
    assert main(["reconstruct", str(log), "--out", str(tmp_path / "run"), "--recipe", "huge"]) == 2
    assert "no recipe 'huge'; `foredrive recipes` lists all" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
