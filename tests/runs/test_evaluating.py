"""Evaluation of an index, by hand on embeddings that are known."""

from pathlib import Path

import pyarrow as pa
import pytest
from small_towers import PlainTowers

from foredrive.errors import InputError
from foredrive.runs.search.evaluating import Share, evaluate_index
from foredrive.search.index import FrameIndex, IndexSettings, Part
from foredrive.search.rows import EMBEDDINGS, WHOLE, row_schema

RAIN, SUN, NIGHT = (1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0)


class WeatherTowers(PlainTowers):
    """A text is the weather that it names."""

    name, fingerprint = "weather", "weather-1"

    def embed_text(self, texts):
        return super().embed_text(
            [
                text.replace("rainy", "red").replace("sunny", "green").replace("night", "blue")
                for text in texts
            ]
        )


def rows_of(log: str, moments: list[tuple[str, str, tuple[float, ...], tuple[float, ...]]]) -> pa.Table:
    """Two rows for each moment, a whole scene and its one view: weather, time of day, image, lidar."""
    rows = []
    for frame, (weather, time_of_day, image, lidar) in enumerate(moments):
        for view in (WHOLE, "ahead"):
            known = {"key": f"{log}@{frame}", "log": log, "folder": f"/{log}", "maps_dir": "/maps"}
            vectors = dict(zip(EMBEDDINGS, (image, lidar, image), strict=True))
            rows.append(
                {**known, "frame": frame, "t_us": frame, "t_s": 0.0, "view": view}
                | {"weather": weather, "time_of_day": time_of_day, **vectors}
            )
    return pa.Table.from_pylist(rows, schema=row_schema(4))


@pytest.fixture
def index(tmp_path: Path) -> FrameIndex:
    made = FrameIndex.make(str(tmp_path / "index"), IndexSettings("weather", "weather-1", 4, 0.5))
    wet = [("rain", "midday", RAIN, RAIN), ("rain", "midday", RAIN, SUN)]
    dry = [("clear", "midday", SUN, SUN), ("clear", "night", NIGHT, NIGHT)]
    parts = [(Part(log, 0, 1, "0"), rows_of(log, moments)) for log, moments in (("wet", wet), ("dry", dry))]
    made.add(parts)
    return made


def test_shares_by_hand(index: FrameIndex) -> None:
    shares = evaluate_index(index, WeatherTowers(), 0)
    assert shares["period.accuracy.image"].value == 1.0
    assert shares["period.accuracy.chance"] == Share(0.5)
    assert shares["weather.accuracy.image"].value == 1.0  # of the three by day
    assert shares["weather.accuracy.lidar"].value == pytest.approx(2 / 3)
    assert shares["weather.class_accuracy.lidar"].value == pytest.approx((1 / 2 + 1) / 2)
    assert shares["weather.rainy (2).lidar"] == Share(0.5)  # of one log: without an interval
    assert shares["weather.accuracy.chance"] == Share(1 / 5)
    # two images are alike, so neither is first; of sweeps, RAIN ties with no other but finds two images
    assert shares["frames.recall_at_1.lidar_to_image"].value == pytest.approx(1 / 4 + 1 / 4)
    assert shares["frames.recall_at_5.image_to_lidar"].value == 1.0
    assert shares["views.recall_at_1.chance"] == Share(0.25)
    low, high = shares["frames.recall_at_1.lidar_to_image"][1:]
    assert low is not None
    assert high is not None
    assert low <= 0.5 <= high
    assert not any(name.startswith("objects") for name in shares)


def test_an_index_without_sweeps_or_of_other_towers_is_refused(index: FrameIndex, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be compared"):
        evaluate_index(index, PlainTowers(), 0)
    empty = FrameIndex.make(str(tmp_path / "empty"), IndexSettings("weather", "weather-1", 4, 0.5))
    with pytest.raises(InputError, match="both an image and a sweep"):
        evaluate_index(empty, WeatherTowers(), 0)
