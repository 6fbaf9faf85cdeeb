"""What is true of a view, and texts that say it."""

import dataclasses
from pathlib import Path

import pytest
import synthetic_log
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.data import LogPath
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.setting import Doing, Place, Setting, TimeOfDay, Weather
from foredrive.scene import Boxes, Category
from foredrive.scene.boxes import unlabelled
from foredrive.search.crops import Crop
from foredrive.search.embedding import read_views
from foredrive.search.facts import NOUNS, Thing, ViewFacts, _things, view_facts
from foredrive.search.phrases import phrases, whole_caption

MANNERS = ("near", "far", "oncoming", "crossing", "moving", "standing")


def boxes(*rows: tuple[Category, tuple[float, float], tuple[float, float], float]) -> Boxes:
    """Category, place, velocity, yaw."""
    count = len(rows)
    return Boxes(
        centre=torch.tensor([[*xy, 0.8] for _, xy, _, _ in rows]),
        size_lwh=torch.ones(count, 3),
        yaw=torch.tensor([yaw for *_, yaw in rows]),
        velocity=torch.tensor([velocity for _, _, velocity, _ in rows]),
        track_id=torch.arange(count),
        category=torch.tensor([int(category) for category, *_ in rows]),
        valid=torch.ones(count, dtype=torch.bool),
        **unlabelled(count),
    )


def test_where_things_are_and_how_they_move() -> None:
    found = _things(
        boxes(
            (Category.CAR, (8.0, 2.0), (0.0, 0.0), 0.0),
            (Category.CAR, (30.0, 3.0), (-8.0, 0.0), 3.1),
            (Category.BUS, (15.0, 0.0), (0.0, 5.0), 1.57),
            (Category.PEDESTRIAN, (14.0, -3.0), (0.1, 1.2), 0.0),
            (Category.PEDESTRIAN, (14.0, -12.0), (0.1, 1.2), 0.0),
            (Category.BICYCLE, (-20.0, 1.0), (5.0, 0.0), 0.0),
            (Category.CAR, (-20.0, 1.0), (-8.0, 0.0), 3.1),
            (Category.CAR, (20.0, 1.0), (torch.nan, torch.nan), 0.0),
            (Category.OTHER, (20.0, 1.0), (0.0, 0.0), 0.0),
        )
    )
    assert list(found) == [
        Thing("car", ("near", "standing")),
        Thing("car", ("far", "moving", "oncoming")),
        Thing("bus", ("moving", "crossing")),
        Thing("pedestrian", ("moving", "crossing")),
        Thing("pedestrian", ("moving",)),
        Thing("cyclist", ("moving",)),
        Thing("car", ("moving",)),  # away from us, behind
        Thing("car", ()),
    ]


def test_facts_count_and_say_what_is_more_general() -> None:
    cars = (Thing("car", ("near", "moving")), Thing("car", ("moving",)))
    view = ViewFacts("morning", "rain", "street", cars)
    assert view.facts == {
        "morning", "day", "rain", "street", "car", "two car", "near car", "one near car", "moving car",
        "two moving car",
    }  # fmt: skip
    assert ViewFacts(None, None, None, ()).facts == {"nobody"}
    assert ViewFacts(None, None, None, None).facts == frozenset()
    many = ViewFacts(None, None, None, (Thing("car", ()),) * 5)
    assert many.facts == {"car", "many car"}


VIEWS = st.builds(
    ViewFacts,
    st.sampled_from([None, "night", "morning", "dusk"]),
    st.sampled_from([None, "rain", "fog", "clear"]),
    st.sampled_from([None, "street", "junction"]),
    st.none()
    | st.lists(
        st.builds(
            Thing,
            st.sampled_from(sorted(NOUNS.values())),
            st.lists(st.sampled_from(MANNERS), unique=True, max_size=3).map(tuple),
        ),
        max_size=5,
    ).map(tuple),
)


@given(VIEWS, st.integers(0, 100))
@settings(max_examples=60, deadline=None)
def test_a_text_never_says_what_does_not_hold(view: ViewFacts, seed: int) -> None:
    told = phrases(view, seed, 4)
    assert len(told) == (4 if view.facts else 0)
    assert phrases(view, seed, 4) == told
    for text, facts in told:
        assert facts <= view.facts
        assert facts
        assert text == text.strip()
        assert "  " not in text
        assert "{" not in text


@pytest.mark.parametrize(
    ("things", "expected"),
    [
        ((Thing("pedestrian", ("crossing",)),), {"a pedestrian crossing the road", "a person crossing"}),
        ((Thing("bus", ()),) * 2, {"two buses", "a bus"}),
        ((Thing("animal", ()),), {"an animal"}),
        ((Thing("pedestrian", ("standing",)),) * 3, {"three people standing", "a standing person"}),
        ((Thing("car", ("oncoming",)),), {"an oncoming car", "a car coming towards us"}),
        ((), {"no one in sight", "nobody around"}),
    ],
)
def test_how_things_are_said(things: tuple[Thing, ...], expected: set[str]) -> None:
    told = {
        phrase.text for seed in range(12) for phrase in phrases(ViewFacts(None, None, None, things), seed, 12)
    }
    assert expected <= told


def test_a_setting_is_said_by_itself_too() -> None:
    told = {p.text: p.facts for p in phrases(ViewFacts("morning", "rain", None, None), 0, 40)}
    assert {"rain"} in [told[text] for text in told if text.endswith(("in the rain", "in rainy weather"))]
    assert {"day"} in list(told.values())


def test_views_of_a_log_have_the_facts_of_what_lies_in_their_sector(log: LogPath) -> None:
    opened = Log(log)
    sectors = {
        name: view.sector for name, view in read_views(opened, 10, 32, Crop.WHOLE, with_lidar=False).items()
    }
    found = view_facts(opened, 10, sectors)
    assert set(found) == set(sectors)
    for facts in found.values():
        assert facts.things is not None
        assert (facts.time_of_day, facts.weather, facts.place) == (None, None, None)
    turned = {name: sector._replace(camera=None, azimuth_rad=3.14) for name, sector in sectors.items()}
    behind = view_facts(opened, 10, turned)
    assert len({facts.things for facts in behind.values()}) == 1


def test_time_weather_and_place_are_recorded_facts_not_a_caption_read_again(tmp_path: Path) -> None:
    night = Setting(
        TimeOfDay.NIGHT, Weather.FOG, Place.BRIDGE, Doing.WAITS, 0.0, None, None,
        hour=23.0, clouds=1.0, rain_mmph=0.0, wetness=0.0, visibility_m=100.0,
    )  # fmt: skip
    specs = synthetic_log.cameras(24, 48)
    plain = dataclasses.replace(synthetic_log.frame(0, specs), caption="Noon, rain, on a street.")
    for setting, told in ((night, ("night", "fog", "bridge")), (None, (None, None, None))):
        with LogWriter(tmp_path, "flat_train", f"log{told[0]}", specs, None, None, None) as writer:
            writer.write(dataclasses.replace(plain, setting=setting))
        opened = Log(LogPath(writer.folder, tmp_path))
        sectors = {
            name: view.sector
            for name, view in read_views(opened, 0, 24, Crop.WHOLE, with_lidar=False).items()
        }
        for facts in view_facts(opened, 0, sectors).values():
            assert facts[:3] == told


def test_a_caption_tells_all_of_a_view_in_one_way() -> None:
    cars = (Thing("car", ("near", "moving")), Thing("car", ("near", "standing")))
    walker = Thing("pedestrian", ("near", "moving", "crossing"))
    view = ViewFacts("night", "rain", "junction", (*cars, walker))
    assert whole_caption(view) == (
        "two cars close by and one pedestrian crossing the road at a junction at night in the rain"
    )
    apart = ViewFacts(None, None, None, (*cars, Thing("car", ("far",)), Thing("bus", ())))
    assert whole_caption(apart) == "one bus and three cars"  # not all of the cars are near
    assert whole_caption(ViewFacts("dawn", None, None, ())) == "nobody around at dawn"
    assert whole_caption(ViewFacts("dawn", "fog", None, None)) == "a scene at dawn in fog"
    assert whole_caption(ViewFacts(None, None, None, None)) is None
