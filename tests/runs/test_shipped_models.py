"""Models that come with the package: written from a run, opened by name, evaluated without training logs."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from benchmarks.common.shipping import MAX_BYTES, ship
from foredrive.cli.main import main
from foredrive.data import LogPath
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.runs import Run, evaluate_run, load_agent, open_run, shipped
from foredrive.runs.drive.agent_inputs import inputs_of, rig_of
from foredrive.runs.model_card import find_card, read_card, shipped_weights
from foredrive.runs.shipped import run_folder
from foredrive.runs.train.driver import DriverRun, is_driver, load_driver, open_driver


@pytest.fixture(scope="module")
def evaluated(trained: Run, log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("run") / "own"
    shutil.copytree(trained.folder, folder)
    own = dataclasses.replace(trained, folder=folder)
    evaluate_run(own, [log], folder, views=False)
    return own


@pytest.fixture(scope="module")
def models(evaluated: Run, log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("package")
    ship(evaluated, "tiny", [log], "Five seconds of a flat road.", "It has seen nothing else.", folder)
    return folder


@pytest.fixture
def package(models: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(shipped, "MODELS", models)
    return models


def test_a_shipped_model_is_evaluated_without_its_training_logs(
    package: Path, evaluated: Run, log: LogPath, tmp_path: Path
) -> None:
    run = open_run(run_folder(Path("embedded:tiny"), tmp_path))
    assert run.logs == ()
    evaluate_run(run, [log], tmp_path / "out", views=False)
    found, before = (
        read_summary(tmp_path / "out" / "summary.json"),
        read_summary(evaluated.folder / "summary.json"),
    )
    for key in ("occupancy.above_ground.iou_now.best_constant", "items"):
        assert found[key] == before[key]
    for key in ("planning.uniad.l2_avg_m", "planning.ego_mlp.uniad.l2_avg_m"):
        assert found[key] == pytest.approx(before[key], rel=0.05, abs=1e-3)


def test_weights_take_a_quarter_and_are_nearly_the_same(
    package: Path, evaluated: Run, tmp_path: Path
) -> None:
    run = open_run(run_folder(Path("embedded:tiny"), tmp_path))
    assert run.weights.stat().st_size < 0.45 * evaluated.weights.stat().st_size  # norms have 16 bits
    pairs = zip(
        load_agent(evaluated).state_dict().items(), load_agent(run).state_dict().values(), strict=True
    )
    for (name, exact), small in pairs:
        if exact.is_floating_point() and exact.dim() > 1:
            row = exact.flatten(1).abs().amax(1)
            error = (exact - small).flatten(1).abs().amax(1)
            assert (error <= row / 253).all(), name
        else:
            torch.testing.assert_close(small, exact, rtol=1e-3, atol=1e-4)


def test_the_card_has_both_figures(package: Path) -> None:
    card = (package / "tiny" / "card.md").read_text()
    assert "Five seconds of a flat road." in card
    assert "| IoU above the ground, now |" in card
    assert "4 clips, 0 failed" in card


def test_a_card_is_read_as_it_was_written(package: Path, evaluated: Run) -> None:
    card = read_card(package / "tiny" / "card.md")
    assert card.markdown() == (package / "tiny" / "card.md").read_text()
    assert (card.name, card.recipe, card.clips, card.failed) == ("tiny", evaluated.recipe.name, 4, 0)
    before = read_summary(evaluated.folder / "summary.json")["occupancy.above_ground.iou_now"]
    assert card.figures["IoU above the ground, now"][0] == pytest.approx(before, abs=5e-4)
    assert (card.data, card.limits) == ("Five seconds of a flat road.", "It has seen nothing else.")


def test_another_file_is_no_card(tmp_path: Path) -> None:
    (tmp_path / "card.md").write_text("# tiny\n\nA model.\n")
    with pytest.raises(InputError, match=r"card.md: not a model card"):
        read_card(tmp_path / "card.md")


def test_all_weights_of_the_package_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    *models, towers = shipped_weights()
    assert [each.name for each in models] == [f"embedded:{name}" for name in shipped.shipped_models()]
    assert all(each.card is not None and each.data and each.commit for each in models)
    for each in (*models, towers):
        assert 5e5 < each.size < 1.2e7
    shares = [
        figures for each in models for title, figures in each.card.figures.items() if title.endswith("%")
    ]
    assert len(shares) >= 2
    assert all(0 < share < 100 for pair in shares for share in pair)
    assert main(["models"]) == 0
    printed = capsys.readouterr().out
    assert all(each.name in printed for each in (*models, towers))
    assert main(["models", models[0].name]) == 0
    assert capsys.readouterr().out == find_card(models[0].name).read_text()
    assert main(["models", "huge"]) == 2
    assert "huge: no such model; there are" in capsys.readouterr().err


def test_a_copy_is_kept_and_one_of_another_version_is_refused(package: Path, tmp_path: Path) -> None:
    folder = run_folder(Path("embedded:tiny"), tmp_path)
    (folder / "summary.json").write_text("{}")
    assert run_folder(Path("embedded:tiny"), tmp_path) == folder
    assert (folder / "summary.json").is_file()
    config = folder / "config.yaml"
    config.write_text(config.read_text() + "\n# of an earlier version\n")
    with pytest.raises(InputError, match="embedded_tiny: not a copy of this version"):
        run_folder(Path("embedded:tiny"), tmp_path)
    assert (folder / "summary.json").is_file()
    assert json.loads((folder / "logs.json").read_text())["cache_dir"] == os.path.abspath(folder / "cache")


def test_unknown_models_and_unevaluated_runs_are_one_line(
    package: Path, trained: Run, log: LogPath, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="embedded:huge: no such model; there are tiny"):
        run_folder(Path("embedded:huge"), tmp_path)
    assert run_folder(tmp_path) == tmp_path
    bare = dataclasses.replace(trained, folder=tmp_path)
    with pytest.raises(InputError, match="evaluate the run first"):
        ship(bare, "other", [log], "", "", tmp_path / "models")


@pytest.mark.parametrize("name", shipped.shipped_models())
def test_the_models_of_the_package_open(name: str, tmp_path: Path) -> None:
    folder = run_folder(Path(f"embedded:{name}"), tmp_path)
    run: Run | DriverRun = open_driver(folder) if is_driver(folder) else open_run(folder)
    assert run.weights.stat().st_size <= MAX_BYTES
    assert (run.folder / "card.md").read_text().startswith(f"# {name}\n")
    agent = load_driver(run) if isinstance(run, DriverRun) else load_agent(run)
    assert all(tensor.isfinite().all() for tensor in agent.state_dict().values())


def test_the_driver_of_the_package_drives_with_its_own_rig(
    models: Path, evaluated: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shipped, "MODELS", models)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="comes without a driver; there are tiny"):
        run_folder(Path("embedded"))
    shutil.copytree(models / "tiny", models / shipped.DRIVER)
    try:
        assert inputs_of("embedded").cameras
        assert rig_of("embedded") == rig_of(str(evaluated.folder))
    finally:
        shutil.rmtree(models / shipped.DRIVER)
