"""Short English texts that are true of a view, with the facts that each text states."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from foredrive.search.facts import COUNTS, EMPTY, MANY, ViewFacts
from foredrive.search.towers import PROMPTS

SETTINGS = {
    "night": ("at night", "in the dark", "by night"),
    "dawn": ("at dawn", "at sunrise"),
    "dusk": ("at dusk", "at sunset"),
    "morning": ("in the morning", "by day"),
    "midday": ("at noon", "by day"),
    "afternoon": ("in the afternoon", "by day"),
    "rain": ("in the rain", "in rainy weather", "on a wet road in the rain"),
    "fog": ("in fog", "in foggy weather", "in the mist"),
    "overcast": ("under a grey sky", "in overcast weather"),
    "cloudy": ("under a cloudy sky", "in cloudy weather"),
    "clear": ("in clear weather", "under a clear sky"),
    "street": ("on a street", "on the road"),
    "junction": ("at a junction", "at an intersection"),
    "roundabout": ("in a roundabout", "at a roundabout"),
    "bridge": ("on a bridge", "on an overpass"),
    "underpass": ("under a bridge", "in an underpass"),
    "highway": ("on a highway", "on a motorway"),
}
NAMES = {
    "truck": ("truck", "lorry"),
    "motorcycle": ("motorcycle", "motorbike"),
    "cyclist": ("cyclist", "bicycle"),
    "pedestrian": ("pedestrian", "person"),
}
"""Alternative names of objects."""
PLURALS = {"person": "people", "bus": "buses", "lorry": "lorries"}
MANNERS = {
    "": ("{}",),
    "near": ("{} close by", "{} nearby"),
    "far": ("{} in the distance", "{} far away"),
    "oncoming": ("{} coming towards us", "oncoming {}"),
    "crossing": ("{} crossing the road", "{} crossing"),
    "moving": ("moving {}", "{} in motion"),
    "standing": ("stationary {}", "{} standing still"),
}
ON_FOOT = {"moving": ("{} walking", "walking {}"), "standing": ("{} standing", "standing {}")}
"""Wordings that differ from `MANNERS` for pedestrians."""
NOBODY = ("nobody around", "no one in sight", "no other traffic")
ALONE = ("{}", "a drive {}", "driving {}", "a scene {}")
"""Templates for a text with settings only."""
TOLD = ("crossing", "oncoming", "near")
"""Properties that a caption states if all objects of a noun have them; the first that holds is used."""
_WORDED, _ALL, _SUBJECT = 0.3, 0.3, 0.75
"""Probabilities that a text uses a prompt template, names all objects, names any object."""


class Phrase(NamedTuple):
    """A text and the facts that make it true."""

    text: str
    facts: frozenset[str]


def phrases(view: ViewFacts, seed: int, count: int) -> list[Phrase]:
    """Return texts that are true of a view, with one or several facts, worded as queries or captions.

    The seed selects facts and wording. Return an empty list for a view without known facts.
    """
    if not view.facts:
        return []
    rng = np.random.default_rng(seed)
    return [_phrase(view, rng) for _ in range(count)]


def whole_caption(view: ViewFacts) -> str | None:
    """Return one sentence with all known facts of a view, in fixed wording. None if nothing is known."""
    settings = [
        SETTINGS[fact][0] for fact in (view.place, view.time_of_day, view.weather) if fact is not None
    ]
    if view.things is None:
        return f"a scene {' '.join(settings)}" if settings else None
    nouns = sorted({thing.noun for thing in view.things})
    parts = [_counted([thing.manners for thing in view.things if thing.noun == noun], noun) for noun in nouns]
    return " ".join([" and ".join(parts) or NOBODY[0], *settings])


def _counted(manners: Sequence[Sequence[str]], noun: str) -> str:
    """Return the number of objects of a noun, with the property of `TOLD` that all of them have."""
    number = COUNTS.get(len(manners), MANY)
    name = noun if len(manners) == 1 else PLURALS.get(noun, f"{noun}s")
    shared = [manner for manner in TOLD if all(manner in thing_manners for thing_manners in manners)]
    return MANNERS[shared[0]][0].format(f"{number} {name}") if shared else f"{number} {name}"


def _phrase(view: ViewFacts, rng: np.random.Generator) -> Phrase:
    settings = [fact for fact in view[:3] if fact is not None]
    kept = [fact for fact in settings if rng.random() < 0.5]
    if view.things is None or (settings and rng.random() >= _SUBJECT):
        # A text without a subject names at least one setting
        kept = kept or [settings[int(rng.integers(len(settings)))]]
        subject, facts = "", set[str]()
    else:
        subject, facts = _subject(view, rng)
    spoken = [_setting(fact, rng) for fact in kept]
    settings_text = " ".join(words for words, _ in spoken)
    text = f"{subject} {settings_text}".strip() if subject else _pick(ALONE, rng).format(settings_text)
    if rng.random() < _WORDED:
        text = _pick(PROMPTS, rng).format(text)
    return Phrase(text, frozenset(facts.union(*(means for _, means in spoken))))


def _setting(fact: str, rng: np.random.Generator) -> tuple[str, set[str]]:
    words = _pick(SETTINGS[fact], rng)
    # These words are true of any daylight, so they state no more than that
    return words, {"day"} if words == "by day" else {fact}


def _subject(view: ViewFacts, rng: np.random.Generator) -> tuple[str, set[str]]:
    assert view.things is not None
    if not view.things:
        return _pick(NOBODY, rng), {EMPTY}
    nouns = sorted({thing.noun for thing in view.things})
    if rng.random() >= _ALL:
        nouns = [nouns[int(rng.integers(len(nouns)))]]
    parts = [_group(view, noun, rng) for noun in nouns]
    texts = [text for text, _ in parts]
    listed = texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"
    return listed, {fact for _, fact in parts}


def _group(view: ViewFacts, noun: str, rng: np.random.Generator) -> tuple[str, str]:
    """Return a text and a fact about the objects of one noun with a common property."""
    assert view.things is not None
    manners = [thing.manners for thing in view.things if thing.noun == noun]
    shared = ["", *sorted({manner for thing_manners in manners for manner in thing_manners})]
    manner = shared[int(rng.integers(len(shared)))]
    count = len(manners) if not manner else sum(manner in thing_manners for thing_manners in manners)
    ways = ON_FOOT.get(manner, MANNERS[manner]) if noun == "pedestrian" else MANNERS[manner]
    name, template = _pick(NAMES.get(noun, (noun,)), rng), _pick(ways, rng)
    fact = f"{manner} {noun}".strip()
    if count == 1 or rng.random() < 0.5:
        words = template.format(name)
        return f"{'an' if words[0] in 'aeio' else 'a'} {words}", fact
    number = COUNTS.get(count, MANY)
    return f"{number} {template.format(PLURALS.get(name, f'{name}s'))}", f"{number} {fact}"


def _pick(ways: Sequence[str], rng: np.random.Generator) -> str:
    return ways[int(rng.integers(len(ways)))]
