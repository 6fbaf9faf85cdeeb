"""Where a reconstruction is trusted: along the way that its log drove, and not far beside it."""

import dataclasses
import json
import math
import shutil
from pathlib import Path
from statistics import fmean

import pytest
import torch

from foredrive.cli.main import main
from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import ShiftEgo, apply_edits
from foredrive.runs.reconstruction.reconstruct import Reconstruction
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.reconstruction.render import plan_frames, render_frame
from foredrive.runs.reconstruction.trust import expected_psnr_db, trained_views, trust_of, trusted_place


def test_expectations_agree_with_the_held_out_images(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    trust = trust_of(opened)
    assert trust.reference_db == pytest.approx(small_run.summary["psnr_db"], abs=1e-3)
    held_s = opened.vehicle.t_s[1::2].tolist()
    expected_db = [expected_psnr_db(trust, opened.vehicle, opened.vehicle.at(t_s)) for t_s in held_s]
    assert fmean(expected_db) == pytest.approx(trust.reference_db, abs=1e-3)
    assert all(map(trust.trusts, expected_db))
    doubled = dataclasses.replace(trust, offset=trust.offset + math.log(2))
    worse_db = expected_psnr_db(doubled, opened.vehicle, opened.vehicle.at(held_s[0]))
    assert 1.0 < expected_db[0] - worse_db < 3.02


def test_beside_the_way_less_is_expected(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    trust = trust_of(opened)
    near, aside, backwards = (
        trusted_place(trust, opened.vehicle, 0.2, left_m, deg)
        for left_m, deg in ((0.0, 0.0), (6.0, 0.0), (0.0, 180.0))
    )
    assert near.trusted
    assert aside.psnr_db < near.psnr_db - 0.5
    assert backwards.psnr_db < near.psnr_db - 2.0
    assert not backwards.trusted
    assert aside.xy[1] == pytest.approx(near.xy[1] + 6.0, abs=0.01)


def test_the_verb_draws_and_writes_what_it_prints(
    small_run: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["trust", str(small_run.folder), "--out", str(tmp_path), "--every", "0.4"]) == 0
    written = json.loads((tmp_path / "trust.json").read_text())
    assert len(written["places"]) == 2 * 11 * 5  # 0 and 0.4 s
    straight = [p for p in written["places"] if p["left_m"] == 0 and p["left_deg"] == 0]
    assert [p["trusted"] for p in straight] == [True, True]
    assert 0 < written["trusted_share"] < 1
    assert (tmp_path / "trust.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert "logged way" in printed
    assert "6 m right" in printed


@torch.no_grad()
def test_what_no_training_image_shows_is_dark(small_run: Reconstruction) -> None:
    """At a training moment the image stays as it is; backwards it loses three quarters of its light."""
    opened = open_reconstruction(small_run.folder)
    plan = plan_frames(opened.vehicle, start_s=float(opened.vehicle.t_s[2]), seconds=0.0)
    dimmed = dataclasses.replace(plan, observed=trained_views(opened))
    for turned_rad, lights in ((0.0, (0.93, 1.0)), (math.pi, (0.2, 0.4))):
        edited = apply_edits(opened.scene.graph, [ShiftEgo((0.0, 0.0, 0.0), turned_rad)])
        plain, dark = (
            render_frame(opened.scene, opened.vehicle, edited, film, 0).images.float().mean()
            for film in (plan, dimmed)
        )
        assert lights[0] < float(dark / plain) <= lights[1]


def test_without_held_out_images_it_is_said(
    small_run: Reconstruction, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(small_run.folder, folder, ignore=shutil.ignore_patterns("cache"))
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({k: v for k, v in summary.items() if k != "psnr_db"}))
    trust = trust_of(open_reconstruction(folder))
    assert trust.offset == 0.0
    assert "no held-out images" in caplog.text


def test_a_run_that_is_not_finished_expects_nothing(small_run: Reconstruction, tmp_path: Path) -> None:
    opened = dataclasses.replace(open_reconstruction(small_run.folder), folder=tmp_path)
    with pytest.raises(InputError, match="not finished"):
        trust_of(opened)
