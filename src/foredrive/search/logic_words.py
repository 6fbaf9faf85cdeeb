"""Negation and numbers in texts, which text towers do not understand, as conditions on columns."""

import re
from collections.abc import Iterable, Iterator

from foredrive.scene import Category
from foredrive.search.phrases import PLURALS
from foredrive.search.rows import COUNTS

NEGATIONS = frozenset({"no", "without", "not", "none", "neither", "zero"})
NOBODY = ("nobody", "no one", "no-one")
NAMES_WITH_NO = frozenset(
    [
        "parking",
        "entry",
        "stopping",
        "standing",
        "waiting",
        "overtaking",
        "passing",
        "outlet",
        "left",
        "right",
        "u",
    ]
)
"""Words after "no" that make the name of a sign: "no parking", "no left turn"."""
NAMES_WITH_NOT = frozenset({"enter", "pass", "block"})
"""Words after "not" that make the name of a sign: "do not enter"."""
NUMBERS = {
    word: number
    for number, word in enumerate(
        ["two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve"], start=2
    )
}
MAX_NUMBER = 30
"""Larger figures are speeds, routes or years."""
_NO_PLURAL = frozenset(["bus", "this", "his", "is", "was", "across"])
_UNITS = frozenset(
    ["metres", "meters", "seconds", "minutes", "hours", "miles", "km", "years", "wheelers", "degrees"]
)
_BETWEEN = frozenset({"a", "an", "any", "other", "visible", "single", "of", "the"})
"""Words that may stand between a negation and its noun without changing what is denied."""
_JOINING = frozenset(
    [
        "and",
        "or",
        "with",
        "without",
        "of",
        "at",
        "in",
        "on",
        "by",
        "near",
        "behind",
        "before",
        "from",
        "to",
        "next",
        "no",
        "not",
    ]
)
"""Words beyond which a number does not reach."""
_NOUNS = {
    "car": Category.CAR,
    "truck": Category.TRUCK,
    "lorry": Category.TRUCK,
    "bus": Category.BUS,
    "trailer": Category.TRAILER,
    "motorcycle": Category.MOTORCYCLE,
    "motorbike": Category.MOTORCYCLE,
    "cyclist": Category.BICYCLE,
    "bicycle": Category.BICYCLE,
    "bike": Category.BICYCLE,
    "pedestrian": Category.PEDESTRIAN,
    "person": Category.PEDESTRIAN,
    "animal": Category.ANIMAL,
    "cone": Category.TRAFFIC_CONE,
    "barrier": Category.BARRIER,
}
_COLUMNS = {
    name: COUNTS[category]
    for noun, category in _NOUNS.items()
    for name in (noun, PLURALS.get(noun, f"{noun}s"))
}


def logic_note(texts: Iterable[str | None], where: str | None) -> str | None:
    """Return one line for texts with a negation or a number of things; None if there is none.

    The line has the condition that says the same, if the noun is that of a column that `where` does not name.
    """
    conditions = [condition for text in texts if text is not None for condition in _conditions(text)]
    columns = [condition for condition in conditions if condition is not None]
    if where is not None and columns:
        columns = [condition for condition in columns if condition.split()[0] not in where]
        if not columns:
            return None
    if not conditions:
        return None
    said = f': --where "{" AND ".join(dict.fromkeys(columns))}"' if columns else ", where there is a column"
    return f"negation and numbers in a text are not understood by the towers; --where says them{said}"


def _conditions(text: str) -> Iterator[str | None]:
    """Yield the condition of each negation and number of things in a text, None where no column says it."""
    plain = text.lower().replace("\u2019", "'")  # apostrophe as typed by word processors
    words = re.findall(r"[a-z0-9]+(?:['-][a-z0-9]+)*", plain)  # "two-way" is one word
    for n, word in enumerate(words):
        rest = words[n + 1 :]
        after = rest[0] if rest else ""
        if word in NOBODY or f"{word} {after}" in NOBODY:
            yield f"{COUNTS[Category.PEDESTRIAN]} = 0"
        elif word in NEGATIONS or word.endswith("n't"):
            names = {"no": NAMES_WITH_NO, "not": NAMES_WITH_NOT}.get(word, frozenset())
            # "bus no. 5" is a number of a line
            if after.split("-")[0] not in names and not after.isdigit():
                noun = next((name for name in rest if name not in _BETWEEN), "")
                column = _COLUMNS.get(noun) if word in ("no", "without", "zero") else None
                yield f"{column} = 0" if column else None
        elif (number := _number(word)) is not None:
            noun = _counted_noun(rest)
            if noun is not None:
                yield f"{_COLUMNS[noun]} >= {number}" if noun in _COLUMNS else None


def _number(word: str) -> int | None:
    if word.isascii() and word.isdigit() and 2 <= int(word) <= MAX_NUMBER:
        return int(word)
    return NUMBERS.get(word)


def _counted_noun(rest: list[str]) -> str | None:
    """Return the plural that a number counts: the first one within three words, such as "parked red cars"."""
    for word in rest[:3]:
        if word in _JOINING or word in _UNITS or "'" in word:
            return None
        plural = word.endswith("s") and not word.endswith("ss") and word not in _NO_PLURAL
        if plural or word in ("people", "men", "women", "children"):
            return word
    return None
