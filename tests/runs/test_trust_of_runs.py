"""Where a reconstruction is trusted: along the way that its log drove, and not far beside it."""

import dataclasses
import json
import math
from pathlib import Path
from statistics import fmean

import pytest

from foredrive.cli.main import main
from foredrive.errors import InputError
from foredrive.runs.reconstruction.reconstruct import Reconstruction
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.runs.reconstruction.trust import expected_psnr_db, trust_of, trusted_place


def test_expectations_agree_with_the_held_out_images(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    trust = trust_of(opened)
    assert trust.reference_db == pytest.approx(small_run.summary["psnr_db"], abs=1e-6)
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


def test_a_run_that_is_not_finished_expects_nothing(small_run: Reconstruction, tmp_path: Path) -> None:
    opened = dataclasses.replace(open_reconstruction(small_run.folder), folder=tmp_path)
    with pytest.raises(InputError, match="not finished"):
        trust_of(opened)
