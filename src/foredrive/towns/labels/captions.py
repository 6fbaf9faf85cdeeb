"""Captions: plain English sentences about what the cameras see, composed from exact facts."""

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foredrive.towns.conditions import Conditions
from foredrive.towns.traffic.lights import Light

SEEN = 0.4
"""Road users of which less is visible go unmentioned: nuScenes' lowest visibility level."""
NEAR_M, AHEAD_M = 30.0, 50.0
"""How far road users beside and behind, and those ahead, are worth words."""
AHEAD_RAD, BEHIND_RAD = np.deg2rad(35.0), np.deg2rad(125.0)
MOVING_MPS, WALKING_MPS = 0.5, 0.3
ONCOMING_COS, ACROSS_COS = -0.8, 0.5
FOG_SHARE = 0.7
"""Of the meteorological range: beyond, fog leaves too little contrast."""
BOTH_SIDES = "on both sides"


class Place(enum.StrEnum):
    """Where the vehicle is."""

    STREET = "street"
    JUNCTION = "junction"
    ROUNDABOUT = "roundabout"
    BRIDGE = "bridge"
    UNDERPASS = "underpass"
    HIGHWAY = "highway"


class Kind(enum.StrEnum):
    """Who or what there is, in one word."""

    CAR = "car"
    VAN = "van"
    TRUCK = "truck"
    BUS = "bus"
    TRAILER = "trailer"
    CONSTRUCTION_VEHICLE = "construction vehicle"
    MOTORCYCLE = "motorcycle"
    CYCLIST = "cyclist"
    PEDESTRIAN = "pedestrian"
    ANIMAL = "animal"
    TRAFFIC_CONE = "traffic cone"
    BARRIER = "barrier"
    OBJECT = "object"

    @property
    def plural(self) -> str:
        """Of several."""
        return f"{self.value}{'es' if self.value.endswith('s') else 's'}"


class Doing(enum.StrEnum):
    """What the vehicle does."""

    DRIVES = "drives"
    TURNS_LEFT = "turns left"
    TURNS_RIGHT = "turns right"
    CHANGES_LEFT = "changes left"
    CHANGES_RIGHT = "changes right"
    FOLLOWS = "follows"
    SLOWS = "slows"
    SPEEDS_UP = "speeds up"
    WAITS = "waits"


@dataclass(frozen=True)
class Thing:
    """A road user in the vehicle's ego frame."""

    kind: Kind
    xy_m: Float[np.ndarray, "2"]
    velocity_mps: Float[np.ndarray, "2"]
    """Over ground, along the ego axes."""
    yaw: float
    visibility: float
    parked: bool = False
    on_road: bool = False
    """Stands on a driving lane."""


@dataclass(frozen=True)
class Situation:
    """What there is to tell of one moment."""

    conditions: Conditions
    place: Place
    doing: Doing
    speed_mps: float
    things: Sequence[Thing]
    leader: Kind | None = None
    """The vehicle right ahead on the same way, if one is seen."""
    light: Light = Light.NONE
    """What the vehicle's own traffic light shows, if it is in view."""


def caption(situation: Situation, seed: int) -> str:
    """Two to six sentences; the seed chooses among phrasings, never among facts."""
    words = _Words(np.random.default_rng(seed))
    seen = [thing for thing in situation.things if _is_seen(thing, situation.conditions)]
    sentences = [
        _setting(situation, words),
        _action(situation, words),
        *_traffic(seen, situation, words),
        *_crossing(seen, words),
        _on_foot(seen, words),
        _parked(seen, words),
        _light(situation, words),
    ]
    return " ".join(f"{s[0].upper()}{s[1:]}." for s in sentences if s)


@dataclass(frozen=True)
class _Words:
    rng: np.random.Generator

    def pick(self, *ways: str) -> str:
        return ways[int(self.rng.integers(len(ways)))]


def _is_seen(thing: Thing, conditions: Conditions) -> bool:
    distance_m = float(np.hypot(*thing.xy_m))
    reach_m = AHEAD_M if _sector(thing) == "ahead" else NEAR_M
    return thing.visibility >= SEEN and distance_m < min(reach_m, FOG_SHARE * conditions.visibility_m)


def _sector(thing: Thing) -> str:
    azimuth = float(np.arctan2(thing.xy_m[1], thing.xy_m[0]))
    if abs(azimuth) <= AHEAD_RAD:
        return "ahead"
    if abs(azimuth) >= BEHIND_RAD:
        return "behind"
    return "left" if azimuth > 0 else "right"


def _setting(situation: Situation, words: _Words) -> str:
    c = situation.conditions
    facts = [_hour(c.hour, words)]
    if c.rain_mmph > 0:
        facts.append("light rain" if c.rain_mmph < 5 else "rain" if c.rain_mmph < 20 else "heavy rain")
    if c.visibility_m < 1000.0:
        facts.append("dense fog" if c.visibility_m < 100.0 else "fog")
    if len(facts) == 1:
        facts.append(_sky(c, words))
    if c.wetness > 0.3 and not c.rain_mmph:
        facts.append(words.pick("wet road", "the road is wet"))
    return ", ".join([*facts, _where(situation.place, words)])


def _hour(hour: float, words: _Words) -> str:
    if hour < 5.3 or hour >= 18.7:
        return words.pick("night", "at night", "a drive by night")
    if hour < 6.7:
        return "dawn"
    if hour >= 17.3:
        return words.pick("dusk", "at dusk")
    if hour < 11.0:
        return words.pick("morning", "in the morning")
    return words.pick("midday", "noon") if hour < 13.0 else words.pick("afternoon", "in the afternoon")


def _sky(c: Conditions, words: _Words) -> str:
    by_day = 6.7 <= c.hour < 17.3
    if c.clouds >= 0.9:
        return words.pick("overcast", "under a grey sky") if by_day else "overcast"
    if c.clouds >= 0.5:
        return words.pick("cloudy", "under broken cloud")
    return words.pick("clear", "sunny", "clear weather") if by_day else words.pick("clear", "dry")


def _where(place: Place, words: _Words) -> str:
    return {
        Place.STREET: words.pick("on a street", "on the road", "along a street"),
        Place.JUNCTION: words.pick("at a junction", "at an intersection", "in a junction"),
        Place.ROUNDABOUT: words.pick("in a roundabout", "on a roundabout"),
        Place.BRIDGE: words.pick("on a bridge", "on an overpass"),
        Place.UNDERPASS: words.pick("under a bridge", "in an underpass"),
        Place.HIGHWAY: words.pick("on a highway", "on a motorway"),
    }[place]


def _action(situation: Situation, words: _Words) -> str:
    leader = situation.leader.value if situation.leader is not None else ""
    speed = f"{5 * max(1, round(situation.speed_mps * 3.6 / 5))} km/h"
    we = words.pick("the ego vehicle", "the ego car")
    match situation.doing:
        case Doing.TURNS_LEFT | Doing.TURNS_RIGHT:
            return f"{we} {situation.doing}"
        case Doing.CHANGES_LEFT | Doing.CHANGES_RIGHT:
            side = "left" if situation.doing is Doing.CHANGES_LEFT else "right"
            return f"{we} " + words.pick(f"changes to the {side} lane", f"moves over to the {side}")
        case Doing.FOLLOWS:
            return f"{we} follows {_a(leader)} at {words.pick('about', 'some')} {speed}"
        case Doing.SLOWS:
            behind = f" behind {_a(leader)}" if leader else ""
            return f"{we} {words.pick('slows down', 'brakes')}{behind}"
        case Doing.SPEEDS_UP:
            return f"{we} {words.pick('speeds up', 'accelerates')}"
        case Doing.WAITS:
            if leader:
                return f"{we} waits behind {_a(leader)}"
            if situation.light in (Light.RED, Light.YELLOW):
                return f"{we} waits at {words.pick('the', 'a')} {_COLOURS[situation.light]} light"
            return f"{we} {words.pick('waits', 'stands still')}"
    return f"{we} {words.pick('drives', 'goes')} at {words.pick('about', 'some')} {speed}"


_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
_COLOURS = {Light.RED: "red", Light.YELLOW: "yellow", Light.GREEN: "green"}


def _a(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeio' else 'a'} {noun}"


def _counted(things: Sequence[Thing], adjective: str = "") -> str:
    """ "two oncoming cars and a bus"."""
    parts = []
    for kind in Kind:
        count = sum(thing.kind is kind for thing in things)
        if count == 1:
            parts.append(_a(f"{adjective}{kind.value}"))
        elif count:
            parts.append(f"{_NUMBERS[count] if count < len(_NUMBERS) else 'many'} {adjective}{kind.plural}")
    return _listed(parts)


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}" if parts else ""


def _traffic(seen: Sequence[Thing], situation: Situation, words: _Words) -> list[str]:
    """Vehicles in traffic, by where they are and where they go."""
    vehicles = [t for t in seen if not t.parked and t.kind is not Kind.PEDESTRIAN]
    there = {where: [t for t in vehicles if _whereabouts(t, situation) == where] for where in _WHEREABOUTS}
    phrases = [
        _counted(things, "oncoming ") if where == "oncoming" else f"{_counted(things)} {words.pick(*ways)}"
        for (where, ways), things in zip(_WHEREABOUTS.items(), there.values(), strict=True)
        if things
    ]
    if phrases:
        return [", ".join(phrases)]
    alone = not seen and situation.leader is None
    return [words.pick("no one else nearby", "no other traffic nearby")] if alone else []


_WHEREABOUTS = {
    "ahead": ("ahead", "in front"),
    "across": ("crossing ahead", "passing across the road ahead"),
    "oncoming": ("",),
    "left": ("on the left", "to the left"),
    "right": ("on the right", "to the right"),
    "behind": ("behind",),
}
"""Where vehicles may be, and how that is said."""


def _whereabouts(thing: Thing, situation: Situation) -> str:
    """One of `_WHEREABOUTS`; where the way bends, none of those ahead is said to drive across it."""
    sector = _sector(thing)
    if sector != "ahead" or np.hypot(*thing.velocity_mps) <= MOVING_MPS:
        return sector
    if np.cos(thing.yaw) < ONCOMING_COS:
        return "oncoming"
    bends = situation.place is Place.ROUNDABOUT or situation.doing in (Doing.TURNS_LEFT, Doing.TURNS_RIGHT)
    return "across" if abs(np.cos(thing.yaw)) < ACROSS_COS and not bends else "ahead"


def _crosses(thing: Thing) -> bool:
    vx, vy = thing.velocity_mps.tolist()
    walks_across = abs(vy) > WALKING_MPS and abs(vy) > abs(vx)
    return thing.kind is Kind.PEDESTRIAN and thing.on_road and walks_across and float(thing.xy_m[0]) > 0


def _crossing(seen: Sequence[Thing], words: _Words) -> list[str]:
    """Who walks across the road in front, and from which side."""
    sentences = []
    for sign, side in ((1.0, "right"), (-1.0, "left")):
        group = [t for t in seen if _crosses(t) and np.sign(t.velocity_mps[1]) == sign]
        if group:
            verb = words.pick("cross", "cross the road", "walk across")
            verb = verb.replace("cross", "crosses", 1) if len(group) == 1 and verb[0] == "c" else verb
            verb = verb.replace("walk", "walks", 1) if len(group) == 1 else verb
            sentences.append(f"{_counted(group)} {verb} from the {side}")
    return sentences


def _on_foot(seen: Sequence[Thing], words: _Words) -> str:
    """People who do not cross."""
    people = [t for t in seen if t.kind is Kind.PEDESTRIAN and not _crosses(t)]
    if not people:
        return ""
    where = _sides(people)
    if any(t.on_road for t in people):
        return f"{_counted(people)} {where}"
    walkway = "on the walkways" if where == BOTH_SIDES else "on the walkway"
    return f"{_counted(people)} {words.pick(f'{walkway} ', '')}{where}"


def _parked(seen: Sequence[Thing], words: _Words) -> str:
    cars = [t for t in seen if t.parked]
    if not cars:
        return ""
    return f"{_counted(cars, 'parked ')} {_sides(cars)}"


def _sides(things: Sequence[Thing]) -> str:
    sides = {"left" if t.xy_m[1] > 0 else "right" for t in things}
    return f"on the {sides.pop()}" if len(sides) == 1 else BOTH_SIDES


def _light(situation: Situation, words: _Words) -> str:
    colour = _COLOURS.get(situation.light)
    waits_there = situation.doing is Doing.WAITS and situation.leader is None and colour != "green"
    if colour is None or waits_there:
        return ""
    ahead = f"{_a(colour)} traffic light ahead"
    if situation.doing in (Doing.TURNS_LEFT, Doing.TURNS_RIGHT):  # not the one that it has just passed
        return ahead
    return words.pick(f"the traffic light is {colour}", f"the light shows {colour}", ahead)
