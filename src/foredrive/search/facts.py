"""Facts of a view: objects with position and motion, time, weather and place."""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.data.boxes import read_boxes
from foredrive.data.logs import Log
from foredrive.data.recorded import read_setting, read_visibility
from foredrive.data.setting import Weather
from foredrive.scene import Boxes, Category
from foredrive.search.sectors import Sector
from foredrive.towns.labels.captions import (
    ACROSS_COS,
    AHEAD_M,
    MIN_VISIBILITY,
    MOVING_MPS,
    ONCOMING_COS,
    WALKING_MPS,
)

NEAR_M, FAR_M = 12.0, 25.0
IN_FOG_M = 25.0
"""Maximum distance of objects in fog."""
ROAD_HALF_M = 8.0
"""Half width of the road. An object that moves sideways within it is "crossing"."""
NOUNS = {
    Category.CAR: "car",
    Category.TRUCK: "truck",
    Category.BUS: "bus",
    Category.TRAILER: "trailer",
    Category.CONSTRUCTION_VEHICLE: "construction vehicle",
    Category.MOTORCYCLE: "motorcycle",
    Category.BICYCLE: "cyclist",
    Category.PEDESTRIAN: "pedestrian",
    Category.ANIMAL: "animal",
    Category.TRAFFIC_CONE: "traffic cone",
    Category.BARRIER: "barrier",
}
COUNTS = {1: "one", 2: "two", 3: "three"}
MANY = "many"
DAY = ("morning", "midday", "afternoon")
EMPTY = "nobody"
"""The fact that no object of `NOUNS` is visible."""


class Thing(NamedTuple):
    """One visible annotated object."""

    noun: str
    manners: tuple[str, ...]
    """Its properties among near, far, oncoming, crossing, moving, standing."""


class ViewFacts(NamedTuple):
    """Facts of one view. None is unknown."""

    time_of_day: str | None
    weather: str | None
    place: str | None
    things: tuple[Thing, ...] | None

    @property
    def facts(self) -> frozenset[str]:
        """Return all facts as short strings: "night", "two car", "crossing pedestrian", "nobody"."""
        facts = {fact for fact in self[:3] if fact is not None}
        if self.time_of_day in DAY:
            facts.add("day")
        if self.things is not None:
            facts |= {EMPTY} if not self.things else set(_counted(self.things))
        return frozenset(facts)


def _counted(things: tuple[Thing, ...]) -> Iterator[str]:
    for noun in {thing.noun for thing in things}:
        manners = [thing.manners for thing in things if thing.noun == noun]
        # The empty manner stands for all objects of the noun
        for manner in {"", *(manner for thing_manners in manners for manner in thing_manners)}:
            count = len(manners) if not manner else sum(manner in thing_manners for thing_manners in manners)
            what = f"{manner} {noun}".strip()
            yield what
            yield f"{COUNTS.get(count, MANY)} {what}"


def view_facts(log: Log, frame: int, sectors: dict[str, Sector]) -> dict[str, ViewFacts]:
    """Return the facts of each sector of a moment, by sector name.

    Time, weather and place come from the recorded setting, if there is one. The objects are boxes whose
    centre is in the sector, near enough and, if the log records visibility, not hidden.

    Raises:
        InputError: data cannot be read.
    """
    recorded = read_setting(log, frame)
    setting: tuple[str | None, str | None, str | None] = (None, None, None)
    if recorded is not None:
        setting = (recorded.time_of_day.value, recorded.weather.value, recorded.place.value)
    boxes, visibility = read_boxes(log, frame), read_visibility(log, frame)
    if boxes is None:
        return {name: ViewFacts(*setting, None) for name in sectors}
    reach_m = IN_FOG_M if recorded is not None and recorded.weather is Weather.FOG else AHEAD_M
    seen = boxes.valid & (boxes.centre[:, :2].norm(dim=-1) < reach_m)
    if visibility is not None:
        seen = seen & ~(visibility < MIN_VISIBILITY)  # Objects of unknown visibility (NaN) are kept
    return {
        name: ViewFacts(*setting, tuple(_things(boxes[seen & sector.contains(boxes.centre)])))
        for name, sector in sectors.items()
    }


def _things(boxes: Boxes) -> Iterator[Thing]:
    rows = zip(boxes.centre, boxes.velocity, boxes.yaw, boxes.category.tolist(), strict=True)
    for centre, velocity, yaw, kind in rows:
        category = Category(kind)
        if category in NOUNS:
            yield Thing(NOUNS[category], tuple(_manners(centre, velocity, yaw, category)))


def _manners(
    centre: Float[Tensor, "3"], velocity: Float[Tensor, "2"], yaw: Float[Tensor, ""], category: Category
) -> Iterator[str]:
    range_m = float(centre[:2].norm())
    if range_m < NEAR_M:
        yield "near"
    elif range_m > FAR_M:
        yield "far"
    if not bool(velocity.isfinite().all()):
        return
    on_foot = category is Category.PEDESTRIAN
    if float(velocity.norm()) <= (WALKING_MPS if on_foot else MOVING_MPS):
        yield "standing"
        return
    yield "moving"
    (x, y), (forward, across) = centre[:2].tolist(), velocity.tolist()
    # Only objects ahead and on the road can cross it or come towards the vehicle
    if x <= 0 or abs(y) > ROAD_HALF_M:
        return
    heading = float(torch.cos(yaw))
    if abs(across) > abs(forward) and (on_foot or abs(heading) < ACROSS_COS):
        yield "crossing"
    elif not on_foot and heading < ONCOMING_COS:
        yield "oncoming"
