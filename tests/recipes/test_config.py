"""Recipes on disk and by name."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from foredrive.errors import InputError
from foredrive.recipes import RECIPES, find_recipe, labelled_by
from foredrive.recipes.config import load_recipe, save_recipe


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_survives_writing_and_reading(name: str, tmp_path: Path) -> None:
    recipe = find_recipe(name)
    save_recipe(recipe, tmp_path / "config.yaml")
    assert load_recipe(tmp_path / "config.yaml") == recipe
    assert recipe.name == name


def test_a_recipe_may_take_its_labels_from_recordings(tmp_path: Path) -> None:
    plain = find_recipe("nemo_tiny")
    recorded = labelled_by(plain, "recorded")
    assert labelled_by(plain, "lidar") == plain
    assert recorded.clips.occupancy_source == "recorded"
    assert recorded.name == "nemo_tiny (recorded occupancy)"
    save_recipe(recorded, tmp_path / "config.yaml")
    assert load_recipe(tmp_path / "config.yaml") == recorded
    entries = yaml.safe_load((tmp_path / "config.yaml").read_text())
    del entries["clips"]["occupancy_source"]  # of a run from before there was a choice
    entries["name"] = plain.name
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(entries))
    assert load_recipe(tmp_path / "config.yaml") == plain


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
    with pytest.raises(InputError, match=f"{tmp_path}: not a run folder, config.yaml cannot be read"):
        load_recipe(tmp_path / "config.yaml")


def test_an_unknown_name_is_told_the_known_ones() -> None:
    with pytest.raises(InputError, match="no recipe 'nemo_huge'; there are: nemo_tiny,"):
        find_recipe("nemo_huge")
