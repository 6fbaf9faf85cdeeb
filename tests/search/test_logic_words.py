"""Negation and numbers in texts: one line with the condition that says them, and none for other texts."""

import pytest

from foredrive.scene import Category
from foredrive.search.logic_words import _COLUMNS, logic_note
from foredrive.search.rows import FACTS


@pytest.mark.parametrize(
    ("text", "condition"),
    [
        ("no cars in sight", "n_car = 0"),
        ("a road without any cars", "n_car = 0"),
        ("No pedestrians, no bikes", "n_pedestrian = 0 AND n_bicycle = 0"),
        ("nobody around", "n_pedestrian = 0"),
        ("no one in sight at night", "n_pedestrian = 0"),
        ("three buses", "n_bus >= 3"),
        ("2 cars at a junction", "n_car >= 2"),
        ("two parked red lorries", "n_truck >= 2"),
        ("five people and no bus", "n_pedestrian >= 5 AND n_bus = 0"),
    ],
)
def test_the_line_has_the_condition(text: str, condition: str) -> None:
    note = logic_note([text, None], None)
    assert note is not None
    assert "\n" not in note
    assert note.endswith(f'--where "{condition}"')
    assert all(word in FACTS.names for word in condition.split() if word.startswith("n_"))


@pytest.mark.parametrize(
    "text",
    ["a car that is not moving", "no traffic", "three traffic lights", "a cyclist who isn't on the road"],
)
def test_without_a_column_the_line_has_no_condition(text: str) -> None:
    note = logic_note([text], None)
    assert note is not None
    assert "n_" not in note


def test_adjectives_are_part_of_what_is_denied() -> None:
    """A view with cars may have no red one, so its count is no condition; of two red cars it is one."""
    note = logic_note(["no red cars"], None)
    assert note is not None
    assert "n_car" not in note


@pytest.mark.parametrize(
    "text",
    [
        "a pedestrian crossing",
        "no parking",
        "a no-parking sign",
        "no left turn sign at a junction",
        "do not enter sign",
        "one car ahead",
        "a two-way street at night",
        "two wheelers",
        "four-way junction",
        "a bus 20 metres ahead",
        "bus no. 5",
        "number 3 bus",
        "at 12 o'clock",
        "route 66 signs",
        "another car is passing",
        "many cars",
        "noon, a note on the window",
    ],
)
def test_other_texts_have_no_line(text: str) -> None:
    assert logic_note([text], None) is None


def test_a_condition_that_is_given_needs_no_line() -> None:
    assert logic_note(["no cars in sight"], "n_car = 0") is None
    note = logic_note(["no cars", "three buses"], "n_car = 0")
    assert note is not None
    assert note.endswith('--where "n_bus >= 3"')


def test_nouns_are_those_of_columns() -> None:
    assert _COLUMNS["people"] == f"n_{Category.PEDESTRIAN.name.lower()}"
    assert _COLUMNS["lorries"] == "n_truck"
    assert _COLUMNS["buses"] == "n_bus"
