"""Recipes on disk and by name."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from foredrive.engine.config import save_recipe
from foredrive.errors import InputError
from foredrive.methods.recipe import with_occupancy_source
from foredrive.runs.recipes.known import RECIPES, find_recipe
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe
from foredrive.runs.recipes.world_models import load_recipe


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_survives_writing_and_reading(name: str, tmp_path: Path) -> None:
    recipe = find_recipe(name)
    save_recipe(recipe, tmp_path / "config.yaml")
    assert load_recipe(tmp_path / "config.yaml") == recipe
    assert recipe.name == name


def test_a_recipe_may_take_its_labels_from_recordings(tmp_path: Path) -> None:
    plain = find_recipe("nemo_tiny")
    recorded = with_occupancy_source(plain, "recorded")
    assert with_occupancy_source(plain, "lidar") == plain
    assert recorded.clips.occupancy_source == "recorded"
    assert recorded.name == "nemo_tiny (recorded occupancy)"
    save_recipe(recorded, tmp_path / "config.yaml")
    assert load_recipe(tmp_path / "config.yaml") == recorded


def without_model(entries: dict[str, Any]) -> None:
    del entries["model"]


def with_words_for_a_rate(entries: dict[str, Any]) -> None:
    entries["pretrain"]["schedule"]["lr"] = "fast"


def with_an_unknown_field(entries: dict[str, Any]) -> None:
    entries["model"]["wings"] = 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without_model, "model"),
        (with_words_for_a_rate, "pretrain.schedule.lr"),
        (with_an_unknown_field, "model.wings"),
    ],
)
def test_what_is_wrong_in_a_config_is_named(
    change: Callable[[dict[str, Any]], None], said: str, tmp_path: Path
) -> None:
    file = tmp_path / "config.yaml"
    save_recipe(find_recipe("nemo_tiny"), file)
    entries = yaml.safe_load(file.read_text())
    change(entries)
    file.write_text(yaml.safe_dump(entries))
    with pytest.raises(InputError, match=said) as caught:
        load_recipe(file)
    assert str(caught.value).startswith(f"{file}: not a recipe: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"a: [", b"- 1", b"just words", b"\xff\xfe\x00", b"\x89PNG\r\n\x1a\n"]
)
def test_a_file_that_is_no_recipe_is_one_line(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    file.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_recipe(file)
    assert str(caught.value).startswith(f"{file}: not a recipe: ")
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_config_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file or directory"):
        load_recipe(tmp_path / "config.yaml")


def test_an_unknown_name_is_told_the_known_ones() -> None:
    with pytest.raises(InputError, match="no recipe 'nemo_bass'; near: nemo_base"):
        find_recipe("nemo_bass")


def test_a_recipe_may_be_a_file_and_entries_may_be_set(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    save_recipe(dataclasses.replace(find_recipe("nemo_town"), name="own"), own)
    settings = (
        "finetune.schedule.lr=1e-3",
        "model.encoder.layers=1",
        "pretrain=null",
        "clips.cameras=[pcam_f0]",
    )
    chosen = find_recipe(str(own), settings)
    assert (chosen.name, chosen.finetune.schedule.lr, chosen.model.encoder.layers) == ("own", 1e-3, 1)
    assert chosen.pretrain is None
    assert chosen.clips.cameras == ("pcam_f0",)
    unchanged = find_recipe("nemo_town")
    assert chosen.planner == unchanged.planner
    assert chosen.finetune.weights == unchanged.finetune.weights


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("lr=1e-3", "no entry 'lr'; did you mean pretrain.schedule.lr?"),
        ("finetune.schedul.lr=1", "no entry 'schedul'; 'schedule' is near"),
        ("finetune.schedule.lr.x=1", "finetune.schedule.lr has no entries"),
        ("finetune.schedule.lr", "write KEY=VALUE"),
        ("finetune.schedule.lr=fast", "nemo_town: not a recipe: finetune.schedule.lr: "),
        ("model.kind=none", "model.kind: 'none' is none of nemo, driveworld"),
        ("clips.cameras=[", "'\\[' is no value"),
    ],
)
def test_a_setting_that_does_not_fit_is_one_line(setting: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        find_recipe("nemo_town", (setting,))
    assert "\n" not in str(caught.value)


def test_recipes_of_reconstructions_take_files_and_settings(tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    save_recipe(find_recipe("gaussians_tiny", (), ReconstructionRecipe), own)
    settings = ("representation.schedule.steps=7", "representation.scene.rolling=false")
    chosen = find_recipe(str(own), settings, ReconstructionRecipe)
    gaussians = chosen.representation
    assert (gaussians.schedule.steps, gaussians.scene.rolling) == (7, False)
    assert gaussians.initial == find_recipe("gaussians_tiny", (), ReconstructionRecipe).representation.initial
    short = tmp_path / "short.yaml"  # what a file leaves out may be set too
    entries = yaml.safe_load(own.read_text())
    del entries["moves_m"]
    short.write_text(yaml.safe_dump(entries))
    assert find_recipe(str(short), ("moves_m=0.25",), ReconstructionRecipe).moves_m == 0.25
    with pytest.raises(InputError, match=r"no entry 'schedule'; did you mean representation\.schedule"):
        find_recipe("gaussians_tiny", ("schedule.steps=7",), ReconstructionRecipe)
    with pytest.raises(InputError, match="near: gaussians_tiny"):
        find_recipe("gaussian_tiny", (), ReconstructionRecipe)
