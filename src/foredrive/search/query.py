"""Queries to an index."""

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
    """An example: a moment of a log, one of its views, or a crop of a view."""

    log: str
    t_s: float
    """Time, s since the log's start."""
    view: str
    crop_px: tuple[int, int, int, int] | None
    """Left, top, right, bottom in px of the log's original image."""


@dataclass(frozen=True)
class Query:
    """A query to an index. Fields that are not set do not restrict it.

    Raises:
        InputError: the query is empty or inconsistent.
    """

    text: str | None = None
    image_text: str | None = None
    """Text to compare images with, if it differs from `text`."""
    lidar_text: str | None = None
    """Text to compare sweeps with, if it differs from `text`."""
    like: str | None = None
    """LOG@SECONDSs, LOG@SECONDSs/VIEW or LOG@SECONDSs/VIEW:LEFT,TOP,RIGHT,BOTTOM."""
    modality: Modality = "image"
    rule: Rule = "features"
    """Rule to combine two modalities (Paper B): sum of features, sum of logits, or the best by image reranked
    by lidar."""
    where: str | None = None
    """SQL condition on the index' columns."""
    tag: str | None = None
    """Tag that moments must have."""
    view: str = ANY_VIEW
    """Views: "any", "sectors", "all" for whole scenes, or the name of one view."""
    top: int = 20
    gap_s: float = 5.0
    """Time in s within which moments of one log count as one hit."""
    diverse: Diversity | None = None
    """Method that selects diverse or representative hits among the best ten times as many."""
    by: str | None = None
    """Numeric column whose large values raise the rank of moments, such as score_missed."""
    mix: float = 0.5
    """Weight of `by` relative to similarity, 0 to 1. Both are converted to ranks."""

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
        if self.top < 1 or not self.gap_s >= 0 or not 0 <= self.mix <= 1:
            raise InputError("top is at least 1, gap at least 0 s, and mix lies between 0 and 1")
        if self.by is not None and self.by not in NUMBERS:
            raise InputError(f"there is no column of numbers {self.by}; there are {', '.join(NUMBERS)}")

    @property
    def compares(self) -> bool:
        """Return whether rows are compared with a text or an example."""
        return any((self.text, self.image_text, self.lidar_text, self.like))

    @property
    def example(self) -> Like | None:
        """Return the parsed example.

        Raises:
            InputError: the example has a wrong format.
        """
        return None if self.like is None else parse_like(self.like)

    @property
    def where_view(self) -> str | None:
        """Return the SQL condition on the view."""
        if self.view == ANY_VIEW:
            return None
        return f"view != {quoted(WHOLE)}" if self.view == ANY_SECTOR else f"view = {quoted(self.view)}"

    def to_json(self) -> str:
        """Return the query as JSON for `from_json`."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> "Query":
        """Restore a saved query.

        Raises:
            InputError: the text is not a query, or it is of another version.
        """
        try:
            values: dict[str, Any] = json.loads(text)
            return cls(**{field.name: values[field.name] for field in fields(cls)})
        except (ValueError, LookupError, TypeError) as error:
            raise InputError(f"not a query: {error}") from error


def parse_like(text: str) -> Like:
    """Parse an example: LOG@12.5s, LOG@12.5s/VIEW, LOG@12.5s/VIEW:LEFT,TOP,RIGHT,BOTTOM.

    Raises:
        InputError: the text has a wrong format.
    """
    # Groups: log, seconds, view, and the four sides of a crop, which needs a view
    match = re.fullmatch(r"(.+)@(\d+(?:\.\d*)?)s?(?:/([^:/]+))?(?::(\d+),(\d+),(\d+),(\d+))?", text.strip())
    if match is None or (match[4] is not None and match[3] is None):
        raise InputError(f"{text!r}: an example is LOG@12.5s, LOG@12.5s/VIEW or LOG@12.5s/VIEW:10,20,110,90")
    crop = None
    if match[4] is not None:
        left, top, right, bottom = (int(match[n]) for n in (4, 5, 6, 7))
        if right <= left or bottom <= top:
            raise InputError(f"{text!r}: a crop is LEFT,TOP,RIGHT,BOTTOM in px, and this one is empty")
        crop = (left, top, right, bottom)
    return Like(match[1], float(match[2]), match[3] or WHOLE, crop)
