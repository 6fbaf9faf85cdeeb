"""Captions: plain English sentences about what the cameras see, composed from the facts of a frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from foredrive.data.setting import Doing, LightColour, ObjectKind, Place, Setting, TimeOfDay, Weather
from foredrive.scene.conditions import FOG_M

MIN_VISIBILITY = 0.4
"""Minimum visibility of road users that are mentioned: nuScenes' lowest visibility level."""
NEAR_M, AHEAD_M = 30.0, 50.0
"""Maximum distance of road users that are mentioned, m: beside and behind, and ahead."""
AHEAD_RAD, BEHIND_RAD = np.deg2rad(35.0), np.deg2rad(125.0)
MOVING_MPS, WALKING_MPS = 0.5, 0.3
ONCOMING_COS, ACROSS_COS = -0.8, 0.5
FOG_SHARE = 0.7
"""Maximum distance in fog, as a fraction of the visibility. Beyond it the contrast is too low."""
BOTH_SIDES = "on both sides"


@dataclass(frozen=True)
class CaptionActor:
    """A road user in the vehicle's ego frame."""

    kind: ObjectKind
    xy_m: Float[np.ndarray, "2"]
    velocity_mps: Float[np.ndarray, "2"]
    """Velocity over ground along the ego axes, m/s."""
    yaw: float
    visibility: float
    parked: bool = False
    on_road: bool = False
    """Whether it stands on a driving lane."""


@dataclass(frozen=True)
class FrameFacts:
    """The facts of one moment."""

    setting: Setting
    actors: Sequence[CaptionActor]


def caption(facts: FrameFacts, seed: int) -> str:
    """Compose a caption of two to six sentences. The seed selects phrasings, never facts."""
    words, setting = _Words(np.random.default_rng(seed)), facts.setting
    # The seed only decides between phrasings: facts are chosen by visibility and distance
    visible = [actor for actor in facts.actors if _is_visible(actor, setting)]
    sentences = [
        _setting(setting, words),
        _action(setting, words),
        *_traffic(visible, setting, words),
        *_crossing(visible, words),
        _on_foot(visible, words),
        _parked(visible),
        _light(setting, words),
    ]
    return " ".join(f"{s[0].upper()}{s[1:]}." for s in sentences if s)


@dataclass(frozen=True)
class _Words:
    rng: np.random.Generator

    def pick(self, *ways: str) -> str:
        return ways[int(self.rng.integers(len(ways)))]


def _is_visible(actor: CaptionActor, setting: Setting) -> bool:
    distance_m = float(np.hypot(*actor.xy_m))
    # Ahead one sees further than beside; fog limits both
    reach_m = AHEAD_M if _sector(actor) == "ahead" else NEAR_M
    return actor.visibility >= MIN_VISIBILITY and distance_m < min(reach_m, FOG_SHARE * setting.visibility_m)


def _sector(actor: CaptionActor) -> str:
    azimuth = float(np.arctan2(actor.xy_m[1], actor.xy_m[0]))
    if abs(azimuth) <= AHEAD_RAD:
        return "ahead"
    if abs(azimuth) >= BEHIND_RAD:
        return "behind"
    return "left" if azimuth > 0 else "right"


def _setting(setting: Setting, words: _Words) -> str:
    facts, rain_mmph = [words.pick(*_HOURS[setting.time_of_day])], setting.rain_mmph
    if rain_mmph > 0:
        facts.append("light rain" if rain_mmph < 5 else "rain" if rain_mmph < 20 else "heavy rain")
    if setting.visibility_m < FOG_M:
        facts.append("dense fog" if setting.visibility_m < 100.0 else "fog")
    if len(facts) == 1:
        facts.append(words.pick(*(_DAY_SKIES if setting.time_of_day in _DAY else _SKIES)[setting.weather]))
    if setting.wetness > 0.3 and not rain_mmph:
        facts.append(words.pick("wet road", "the road is wet"))
    return ", ".join([*facts, _place_phrase(setting.place, words)])


_DAY = (TimeOfDay.MORNING, TimeOfDay.MIDDAY, TimeOfDay.AFTERNOON)
_HOURS = {
    TimeOfDay.NIGHT: ("night", "at night", "a drive by night"),
    TimeOfDay.DAWN: ("dawn",),
    TimeOfDay.DUSK: ("dusk", "at dusk"),
    TimeOfDay.MORNING: ("morning", "in the morning"),
    TimeOfDay.MIDDAY: ("midday", "noon"),
    TimeOfDay.AFTERNOON: ("afternoon", "in the afternoon"),
}
_DAY_SKIES = {
    Weather.OVERCAST: ("overcast", "under a grey sky"),
    Weather.CLOUDY: ("cloudy", "under broken cloud"),
    Weather.CLEAR: ("clear", "sunny", "clear weather"),
}
_SKIES = _DAY_SKIES | {Weather.OVERCAST: ("overcast",), Weather.CLEAR: ("clear", "dry")}


def _place_phrase(place: Place, words: _Words) -> str:
    return {
        Place.STREET: words.pick("on a street", "on the road", "along a street"),
        Place.JUNCTION: words.pick("at a junction", "at an intersection", "in a junction"),
        Place.ROUNDABOUT: words.pick("in a roundabout", "on a roundabout"),
        Place.BRIDGE: words.pick("on a bridge", "on an overpass"),
        Place.UNDERPASS: words.pick("under a bridge", "in an underpass"),
        Place.HIGHWAY: words.pick("on a highway", "on a motorway"),
    }[place]


def _action(setting: Setting, words: _Words) -> str:
    leader = setting.leader.value if setting.leader is not None else ""
    speed = f"{5 * max(1, round(setting.speed_mps * 3.6 / 5))} km/h"
    we = words.pick("the ego vehicle", "the ego car")
    match setting.doing:
        case Doing.TURNS_LEFT | Doing.TURNS_RIGHT:
            return f"{we} {setting.doing}"
        case Doing.CHANGES_LEFT | Doing.CHANGES_RIGHT:
            side = "left" if setting.doing is Doing.CHANGES_LEFT else "right"
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
            if setting.light in (LightColour.RED, LightColour.YELLOW):
                return f"{we} waits at {words.pick('the', 'a')} {setting.light} light"
            return f"{we} {words.pick('waits', 'stands still')}"
    return f"{we} {words.pick('drives', 'goes')} at {words.pick('about', 'some')} {speed}"


_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")


def _a(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeio' else 'a'} {noun}"


def _counted(actors: Sequence[CaptionActor], adjective: str = "") -> str:
    """Return a phrase such as "two oncoming cars and a bus"."""
    parts = []
    for kind in ObjectKind:
        count = sum(actor.kind is kind for actor in actors)
        if count == 1:
            parts.append(_a(f"{adjective}{kind.value}"))
        elif count:
            parts.append(f"{_NUMBERS[count] if count < len(_NUMBERS) else 'many'} {adjective}{_plural(kind)}")
    return _listed(parts)


def _plural(kind: ObjectKind) -> str:
    return f"{kind}{'es' if kind.endswith('s') else 's'}"


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}" if parts else ""


def _traffic(visible: Sequence[CaptionActor], setting: Setting, words: _Words) -> list[str]:
    """Describe the moving vehicles by their position and direction."""
    vehicles = [t for t in visible if not t.parked and t.kind is not ObjectKind.PEDESTRIAN]
    # Each moving vehicle belongs to one group by sector and direction
    groups = {where: [t for t in vehicles if _direction(t, setting) == where] for where in _DIRECTIONS}
    phrases = [
        _counted(actors, "oncoming ") if where == "oncoming" else f"{_counted(actors)} {words.pick(*ways)}"
        for (where, ways), actors in zip(_DIRECTIONS.items(), groups.values(), strict=True)
        if actors
    ]
    if phrases:
        return [", ".join(phrases)]
    alone = not visible and setting.leader is None
    return [words.pick("no one else nearby", "no other traffic nearby")] if alone else []


_DIRECTIONS = {
    "ahead": ("ahead", "in front"),
    "across": ("crossing ahead", "passing across the road ahead"),
    "oncoming": ("",),
    "left": ("on the left", "to the left"),
    "right": ("on the right", "to the right"),
    "behind": ("behind",),
}
"""Possible positions of vehicles, and phrases for them."""


def _direction(actor: CaptionActor, setting: Setting) -> str:
    """Return one of `_DIRECTIONS`. In bends no vehicle ahead counts as crossing."""
    sector = _sector(actor)
    if sector != "ahead" or np.hypot(*actor.velocity_mps) <= MOVING_MPS:
        return sector
    if np.cos(actor.yaw) < ONCOMING_COS:
        return "oncoming"
    # In bends the road ahead turns, and with it the vehicles on it
    bends = setting.place is Place.ROUNDABOUT or setting.doing in (Doing.TURNS_LEFT, Doing.TURNS_RIGHT)
    return "across" if abs(np.cos(actor.yaw)) < ACROSS_COS and not bends else "ahead"


def _crosses(actor: CaptionActor) -> bool:
    vx, vy = actor.velocity_mps.tolist()
    walks_across = abs(vy) > WALKING_MPS and abs(vy) > abs(vx)
    return actor.kind is ObjectKind.PEDESTRIAN and actor.on_road and walks_across and float(actor.xy_m[0]) > 0


def _crossing(visible: Sequence[CaptionActor], words: _Words) -> list[str]:
    """Describe the pedestrians that walk across the road in front, and the side from which they come."""
    sentences = []
    # Sign of the lateral velocity: positive moves to the left, so it comes from the right
    for sign, side in ((1.0, "right"), (-1.0, "left")):
        group = [t for t in visible if _crosses(t) and np.sign(t.velocity_mps[1]) == sign]
        if group:
            verb = words.pick("cross", "cross the road", "walk across")
            verb = verb.replace("cross", "crosses", 1) if len(group) == 1 and verb[0] == "c" else verb
            verb = verb.replace("walk", "walks", 1) if len(group) == 1 else verb
            sentences.append(f"{_counted(group)} {verb} from the {side}")
    return sentences


def _on_foot(visible: Sequence[CaptionActor], words: _Words) -> str:
    """Describe the pedestrians that do not cross."""
    people = [t for t in visible if t.kind is ObjectKind.PEDESTRIAN and not _crosses(t)]
    if not people:
        return ""
    where = _sides(people)
    if any(t.on_road for t in people):
        return f"{_counted(people)} {where}"
    walkway = "on the walkways" if where == BOTH_SIDES else "on the walkway"
    return f"{_counted(people)} {words.pick(f'{walkway} ', '')}{where}"


def _parked(visible: Sequence[CaptionActor]) -> str:
    cars = [t for t in visible if t.parked]
    if not cars:
        return ""
    return f"{_counted(cars, 'parked ')} {_sides(cars)}"


def _sides(actors: Sequence[CaptionActor]) -> str:
    sides = {"left" if t.xy_m[1] > 0 else "right" for t in actors}
    return f"on the {sides.pop()}" if len(sides) == 1 else BOTH_SIDES


def _light(setting: Setting, words: _Words) -> str:
    colour = setting.light
    waits_there = setting.doing is Doing.WAITS and setting.leader is None and colour is not LightColour.GREEN
    if colour is None or waits_there:
        return ""
    ahead = f"{_a(colour)} traffic light ahead"
    if setting.doing in (Doing.TURNS_LEFT, Doing.TURNS_RIGHT):  # not the light that it has just passed
        return ahead
    return words.pick(f"the traffic light is {colour}", f"the light shows {colour}", ahead)
