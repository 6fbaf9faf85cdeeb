"""Towers that know all and towers that know nothing, judged on views of made-up drives."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.common.retrieval_quality import (
    MODALITIES,
    WEATHERS,
    Judged,
    Ranking,
    judge_naming,
    judge_retrieval,
    precision_at,
    questions,
    weather_of,
)
from foredrive.runs.search.sector_views import ViewRow
from foredrive.search.crops import Crop
from foredrive.search.facts import Thing, ViewFacts
from foredrive.search.phrases import SETTINGS
from foredrive.search.towers import unit

ASKED = questions()
FACTS = sorted({fact for question in ASKED for fact in question.facts})


class AllKnowing:
    """Texts are what they say, one number for each fact; so are views."""

    name, fingerprint, dim, image_side_px = "all-knowing", "1", len(FACTS), 8
    crop, has_lidar = Crop.WHOLE, True

    def embed_images(self, images: Tensor) -> Tensor:
        raise AssertionError

    def embed_sweeps(self, sweeps: object) -> None:
        raise AssertionError

    def embed_text(self, texts: Sequence[str]) -> Tensor:
        return torch.stack([self._facts(text) for text in texts])

    def _facts(self, text: str) -> Tensor:
        said = [q.facts for q in ASKED if q.text in text]
        named = {weather for weather, ways in WEATHERS.items() if any(way in text for way in ways)}
        longest = max(said, key=len, default=frozenset[str]())
        return torch.tensor([float(fact in longest | named) for fact in FACTS])


def drives() -> list[ViewRow]:
    """Two drives of ten moments in each weather: a car in every other view, one truck among them."""
    told = {"clear": ("midday", "clear"), "night": ("night", "clear"), "rain": ("midday", "rain")}
    rows = []
    for weather, (time, air) in told.items():
        for number in range(2):
            for frame in range(10):
                nouns = ["car"] * (frame % 2 == 0) + ["truck"] * (frame == 4)
                things = tuple(Thing(noun, ("near",)) for noun in nouns)
                facts = ViewFacts(time, air, "street", things)
                rows.append(ViewRow(f"town/{weather}{number}", frame, "ahead", facts))
    return rows


def judged(vectors: np.ndarray) -> Judged:
    rows = drives()
    t_us = np.array([row.frame * 6_000_000 for row in rows])
    return Judged(rows, t_us, dict.fromkeys(("image", "lidar", "joint"), vectors))


def truth() -> np.ndarray:
    """What each view shows; its weather by one name alone."""
    rows = drives()
    known = [(row.facts.facts - set(WEATHERS)) | {weather_of(row)} for row in rows]
    return unit(torch.tensor([[float(f in facts) for f in FACTS] for facts in known])).numpy()


def test_who_knows_all_finds_all() -> None:
    figures = judge_retrieval(judged(truth()), AllKnowing())
    assert set(figures) == set(MODALITIES)
    assert figures["image"]["all.every.p_at_1"] == figures["joint_logits"]["night.every.p_at_10"] == 1
    assert figures["lidar"]["all.every.p_at_10_above_image"] == 0
    assert figures["chance"]["all.thing.p_at_10"] < 0.9
    assert "all.composed.p_at_10" in figures["image"]
    low, value, high = (figures["chance"][f"all.thing.p_at_10{end}"] for end in ("_low", "", "_high"))
    assert low <= value <= high
    # trucks are too few to be asked for in one weather (two, and three are wanted); cars and two manners are
    assert figures["image"]["night.every.questions"] == 3
    assert figures["image"]["all.thing.questions"] == 2


def test_weather_is_named_by_texts_alone() -> None:
    named = judge_naming(judged(truth()), AllKnowing())["image"]
    assert named["zero_shot_accuracy"] == named["night.zero_shot_accuracy"] == 1
    blind = judge_naming(judged(np.tile(truth()[:1], (len(drives()), 1))), AllKnowing())["lidar"]
    assert blind["zero_shot_accuracy"] == pytest.approx(1 / 3)  # everything is called clear


def test_weather_of_a_drive() -> None:
    row = drives()[0]
    told = {"rain": ("night", "rain"), "night": ("night", "clear"), "clear": ("dusk", "cloudy")}
    for weather, (time, air) in told.items():
        assert weather_of(row._replace(facts=ViewFacts(time, air, None, None))) == weather
    assert set(WEATHERS) <= set(SETTINGS)


OUT = -np.inf
RANKING = Ranking(
    score=np.array([[0.9, 0.1, OUT], [0.8, 0.7, 0.2]]),
    true=np.array([[True, True, False], [False, True, False]]),
    could=np.array([2, 1]),
)
"""In order: true, false, true, false, true; three could be."""


def test_precision_by_hand() -> None:
    drawn = np.array([[0, 1], [0, 0], [1, 1]])
    found = precision_at(RANKING, drawn, (1, 2, 10))
    np.testing.assert_allclose(found[0], [1, 1 / 2, 3 / 3])
    np.testing.assert_allclose(found[1], [1, 1, 4 / 4])  # the first drive twice: four hits, all true
    np.testing.assert_allclose(found[2], [0, 0, 2 / 2])  # false and false, then both true ones


def test_what_nothing_answers_has_no_precision() -> None:
    nothing = Ranking(RANKING.score, np.zeros((2, 3), dtype=bool), np.zeros(2, dtype=int))
    assert np.isnan(precision_at(nothing, np.array([[0, 1]]), (1, 10))).all()
