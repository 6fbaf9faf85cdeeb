"""From pre-training to fine-tuning by the encoder alone: the rows of DriveWorld's Table 1."""

import dataclasses
from pathlib import Path

import pytest
import torch
from miniature import miniature_driveworld, with_steps
from safetensors.torch import load_file

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.methods.driveworld.ablations import driveworld_ablations
from foredrive.runs import train_run
from foredrive.runs.recipes.known import RECIPES
from foredrive.runs.train.run import fresh_agent

ROWS = driveworld_ablations(with_steps(miniature_driveworld(), pretrain=2, finetune=0))
NAMES = {row.removeprefix("miniature_driveworld_"): row for row in ROWS}
CARRIED_OVER = ("world_model.backbone.", "world_model.encoder.")


def test_only_the_encoder_comes_from_pretraining(log: LogPath, tmp_path: Path) -> None:
    """Fine-tuning of no steps leaves the weights that it starts from."""
    starts = {}
    for row in ("rssm", "mln", "scratch"):
        folder = tmp_path / row
        train_run(ROWS[NAMES[row]], [log], folder, tmp_path / "cache")
        starts[row] = load_file(folder / "finetune" / "model.safetensors")
        fresh = fresh_agent(ROWS[NAMES[row]]).state_dict()
        assert starts[row].keys() == fresh.keys()
        expected = fresh
        if row != "scratch":
            pretrained = load_file(folder / "pretrain" / "model.safetensors")
            expected = {key: (pretrained if key.startswith(CARRIED_OVER) else fresh)[key] for key in fresh}
            moved = [key for key in fresh if not torch.equal(fresh[key], expected[key])]
            assert len(moved) > 20
            assert not any(
                torch.equal(pretrained[k], fresh[k]) for k in fresh if k.endswith("lateral.0.weight")
            )
        assert all(torch.equal(starts[row][key], expected[key]) for key in fresh)
    heads = [key for key in starts["rssm"] if not key.startswith(CARRIED_OVER)]
    assert heads
    assert all(torch.equal(starts["rssm"][key], starts[row][key]) for key in heads for row in starts)


def test_a_run_starts_from_another_by_the_encoder_alone(log: LogPath, tmp_path: Path) -> None:
    """Whatever else was pre-trained may have other sizes."""
    first = train_run(ROWS[NAMES["rssm"]], [log], tmp_path / "first", tmp_path / "cache")
    recipe = ROWS[NAMES["prompts"]]
    second = train_run(recipe, [log], tmp_path / "second", tmp_path / "cache", start=first.folder)
    ours, theirs = (load_file(run.folder / "finetune" / "model.safetensors") for run in (first, second))
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[key], theirs[key]) for key in ours)
    whole = dataclasses.replace(recipe, transfer="world_model")
    with pytest.raises(InputError, match="another architecture"):
        train_run(whole, [log], tmp_path / "third", tmp_path / "cache", start=first.folder)


@pytest.mark.parametrize("size", ["town", "base"])
def test_the_rows_of_table_1_differ_in_pretraining_alone(size: str) -> None:
    rows = {
        row: RECIPES[f"driveworld_{size}_{row}"] for row in NAMES if f"driveworld_{size}_{row}" in RECIPES
    }
    table = {name: row for name, row in rows.items() if name != "carried"}
    assert set(table) == {"scratch", "occupancy", "rssm", "ssp", "dmb", "mln", "prompts"}
    full = RECIPES[f"driveworld_{size}"]
    for row in table.values():
        assert (row.model, row.planner, row.finetune) == (full.model, full.planner, full.finetune)
        assert row.transfer == "encoder" or row.pretrain is None
        first = row.of_pretraining.model
        assert (first.backbone, first.encoder, first.channels) == (
            full.model.backbone,
            full.model.encoder,
            full.model.channels,
        )
    found = [table[name].of_pretraining.model for name in ("rssm", "ssp", "dmb", "mln", "prompts")]
    parts = [
        (m.statics is not None, m.states.memory_bank, m.states.motion_norm, m.prompt is not None)
        for m in found
    ]
    assert [sum(row) for row in parts] == [0, 1, 2, 3, 4]
    assert parts == sorted(parts)
