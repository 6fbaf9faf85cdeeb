"""Whether an index shows what a text is about: shares by hand, towers that know some words alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from small_towers import PlainTowers
from torch import Tensor

from foredrive.search.index import FrameIndex, IndexSettings, Part
from foredrive.search.resemblance import LEAST_ROWS, UNRELATED, principal_directions, resembles, shown_share
from foredrive.search.rows import row_schema

DIM = 8


class FewWords(PlainTowers):
    """Towers that put texts with a car or a road where images differ, and each other text anywhere else."""

    dim = DIM

    def embed_text(self, texts: Sequence[str]) -> Tensor:
        placed = torch.zeros(len(texts), DIM)
        for row, text in zip(placed, texts, strict=True):
            row[:] = 0.1
            row[0 if "car" in text else 1 if "road" in text else 4 + len(text) % 4] = 1.0
        return placed


def made_index(folder: Path, moments: int, blind: int = 0) -> FrameIndex:
    """Images differ along the first three axes, and nowhere else; `blind` rows have none."""
    vectors = np.full((moments, DIM), 0.5, np.float32)
    vectors[:, :3] += np.random.default_rng(0).normal(size=(moments, 3))
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    rows = [
        {
            "key": f"a@{number}", "log": "a", "folder": "/a", "maps_dir": "/maps", "frame": number,
            "t_us": number, "t_s": 0.5 * number, "view": "all",
            "image": None if number < blind else vector, "lidar": None, "joint": vector,
        }
        for number, vector in enumerate(vectors)
    ]  # fmt: skip
    index = FrameIndex.make(str(folder), IndexSettings("few", "few-1", DIM, 0.5))
    index.add([(Part("a", 0, moments - 1, "digest"), pa.Table.from_pylist(rows, schema=row_schema(DIM)))])
    return index


def test_shares_by_hand() -> None:
    """Points on a line in a plane: one direction holds 90 % of the variance, both hold all."""
    points = np.array([[3.0, 1.0, 7.0], [-3.0, 1.0, 7.0], [3.0, -1.0, 7.0], [-3.0, -1.0, 7.0]])
    assert np.abs(principal_directions(points, 0.89)) == pytest.approx(np.eye(3)[:1])
    assert np.abs(principal_directions(points, 0.95)) == pytest.approx(np.eye(3)[:2])
    texts = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert shown_share(np.eye(3)[:1], texts) == pytest.approx([0.36, 0.0, 0.0])
    assert shown_share(np.eye(3)[:2], texts) == pytest.approx([0.36, 1.0, 0.0])


def test_a_text_has_to_be_shown_better_than_unrelated_ones(tmp_path: Path) -> None:
    index, towers = made_index(tmp_path / "index", 2 * LEAST_ROWS), FewWords()
    assert not any("road" in text for text in UNRELATED)
    for text, shown in (("a car", True), ("a road", True), ("an elephant", False)):
        vector = torch.nn.functional.normalize(towers.embed_text([text])[0], dim=0).numpy()
        assert resembles(index, vector, towers) is shown


def test_few_images_tell_nothing(tmp_path: Path) -> None:
    towers = FewWords()
    elephant = np.eye(DIM, dtype=np.float32)[5]
    assert resembles(made_index(tmp_path / "few", LEAST_ROWS - 1), elephant, towers) is None
    assert resembles(made_index(tmp_path / "blind", 2 * LEAST_ROWS, LEAST_ROWS + 1), elephant, towers) is None


def test_samples_are_spread_over_the_table(tmp_path: Path) -> None:
    index = made_index(tmp_path / "index", 1000)
    numbers = np.array(index.sample(["frame"], 64)["frame"].to_pylist())
    assert len(set(numbers)) == len(numbers) == 64
    assert np.histogram(numbers, 4, (0, 1000))[0].tolist() == [16, 16, 16, 16]
    assert len(index.sample(["frame"], 1000)) == 1000
