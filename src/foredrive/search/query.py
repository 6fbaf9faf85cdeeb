"""What is asked of an index."""

import json
import re
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, NamedTuple, get_args

import pyarrow as pa

from foredrive.errors import InputError
from foredrive.search.rows import FACTS, WHOLE
from foredrive.search.tables import quoted

Modality = Literal["image", "lidar", "joint"]
Rule = Literal["features", "logits", "rerank"]
Diversity = Literal["k-centre", "facility"]
NUMBERS = [field.name for field in FACTS if field.type != pa.string()]
ANY_VIEW, ANY_SECTOR = "any", "sectors"


class Like(NamedTuple):
    """An example: a moment of a log, one view of it, or a crop of that."""

    log: str
    t_s: float
    """Since the log's start."""
    view: str
    crop_px: tuple[int, int, int, int] | None
    """Left, top, right, bottom in the log's own image."""


@dataclass(frozen=True)
class Query:
    """A question; what is left out does not matter.

    Raises:
        InputError: nothing is asked for, or what is asked for does not go together.
    """

    text: str | None = None
    image_text: str | None = None
    """What images are compared with, where that differs from `text`."""
    lidar_text: str | None = None
    """What sweeps are compared with, where that differs from `text`."""
    like: str | None = None
    """LOG@SECONDSs, LOG@SECONDSs/VIEW or LOG@SECONDSs/VIEW:LEFT,TOP,RIGHT,BOTTOM."""
    modality: Modality = "image"
    rule: Rule = "features"
    """How two modalities are joined (Paper B): the sum of features, the sum of logits, or the best by image
    ranked again by lidar."""
    where: str | None = None
    """A condition in SQL on the index' columns."""
    tag: str | None = None
    """Only moments that have it."""
    view: str = ANY_VIEW
    """"any", "sectors", "all" for whole scenes, or the name of one."""
    top: int = 20
    gap_s: float = 5.0
    """Moments of one log that are closer than this are one hit."""
    diverse: Diversity | None = None
    """Of the best ten times as many, those that differ most or stand for most."""
    by: str | None = None
    """A column of numbers that makes moments more wanted, such as score_missed."""
    mix: float = 0.5
    """What `by` weighs beside likeness, 0 to 1; both count by their ranks."""

    def __post_init__(self) -> None:
        for name in ("text", "image_text", "lidar_text", "like", "where"):
            value = getattr(self, name)
            if value is not None and not value.strip():
                raise InputError(f"an empty {name.replace('_', ' ')} finds nothing")
        if not (self.compares or self.where or self.by or self.tag):
            raise InputError("an empty query: look for a text, or by --like, --where, --by or --tagged")
        if self.like is not None and (self.text or self.image_text or self.lidar_text):
            raise InputError("a query is a text or an example, not both")
        for name, kinds in (("modality", Modality), ("rule", Rule)):
            if (value := getattr(self, name)) not in get_args(kinds):
                raise InputError(f"{name} is one of {', '.join(get_args(kinds))}, not {value!r}")
        if self.top < 1 or self.gap_s < 0 or not 0 <= self.mix <= 1:
            raise InputError("top is at least 1, gap at least 0 s, and mix lies between 0 and 1")
        if self.by is not None and self.by not in NUMBERS:
            raise InputError(f"there is no column of numbers {self.by}; there are {', '.join(NUMBERS)}")

    @property
    def compares(self) -> bool:
        """Whether rows are compared with a text or an example."""
        return any((self.text, self.image_text, self.lidar_text, self.like))

    @property
    def example(self) -> Like | None:
        """The example, taken apart.

        Raises:
            InputError: it is not written as one.
        """
        return None if self.like is None else parse_like(self.like)

    @property
    def where_view(self) -> str | None:
        """The condition on rows' views."""
        if self.view == ANY_VIEW:
            return None
        return f"view != {quoted(WHOLE)}" if self.view == ANY_SECTOR else f"view = {quoted(self.view)}"

    def to_json(self) -> str:
        """What `from_json` reads."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Query":
        """A query that was kept.

        Raises:
            InputError: it is none, or of another version.
        """
        try:
            told: dict[str, Any] = json.loads(text)
            return cls(**{field.name: told[field.name] for field in fields(cls)})
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(f"not a query: {error}") from error


def parse_like(text: str) -> Like:
    """Take an example apart: LOG@12.5s, LOG@12.5s/VIEW, LOG@12.5s/VIEW:LEFT,TOP,RIGHT,BOTTOM.

    Raises:
        InputError: it is not written so.
    """
    found = re.fullmatch(r"(.+)@(\d+(?:\.\d*)?)s?(?:/([^:/]+))?(?::(\d+),(\d+),(\d+),(\d+))?", text.strip())
    if found is None or (found[4] is not None and found[3] is None):
        raise InputError(f"{text!r}: an example is LOG@12.5s, LOG@12.5s/VIEW or LOG@12.5s/VIEW:10,20,110,90")
    crop = None
    if found[4] is not None:
        left, top, right, bottom = (int(found[n]) for n in (4, 5, 6, 7))
        if right <= left or bottom <= top:
            raise InputError(f"{text!r}: a crop is LEFT,TOP,RIGHT,BOTTOM in px, and this one is empty")
        crop = (left, top, right, bottom)
    return Like(found[1], float(found[2]), found[3] or WHOLE, crop)
