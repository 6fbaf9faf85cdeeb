"""A page that searches an index: a grid of hits, conditions, and a map of scenes with a lasso."""

import functools
import io
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

from PIL import Image

from foredrive.errors import InputError
from foredrive.json_http import validated
from foredrive.json_server import Answer, JsonServer, Raw
from foredrive.runs.search.searching import answer_notes, ask, listed_clips
from foredrive.search.find import Hit
from foredrive.search.index import FrameIndex
from foredrive.search.projection import project_scenes
from foredrive.search.query import Query
from foredrive.search.rows import FACTS, IndexRow
from foredrive.search.saved import add_tag, save_query, saved_queries
from foredrive.search.tables import quoted_list
from foredrive.view.hit_picture import content_text, hit_name, hit_picture, score_text
from foredrive.view.html import render_page

JPEG_QUALITY = 85
MAX_SHOWN = 60
"""Maximum number of scenes shown from a lasso."""
MAX_TOP = 1000
"""Maximum number of hits of a query."""
MAX_BODY_BYTES = 2**20


@dataclass(frozen=True)
class ShownHit:
    """The values of a hit that the page shows."""

    key: str
    name: str
    score: str
    content: str
    caption: str | None

    @classmethod
    def of(cls, hit: Hit) -> "ShownHit":
        """Return the shown values of a hit."""
        score = score_text(hit) if hit.scores else ""
        return cls(_key(hit.row), hit_name(hit), score, content_text(hit), hit.row.caption)


@dataclass(frozen=True)
class ShownHits:
    """Hits, and a line about the search."""

    hits: list[ShownHit]
    message: str


@dataclass(frozen=True)
class MapPoint:
    """A whole scene on the map: its position, -1 to 1, and the facts that can colour it."""

    x: float
    y: float
    key: str
    moment: str
    name: str
    log: str
    place: str | None
    weather: str | None
    time_of_day: str | None

    @classmethod
    def of(cls, xy: Sequence[float], row: IndexRow) -> "MapPoint":
        """Return the point of a row of the index."""
        facts = (row.log, row.place, row.weather, row.time_of_day)
        return cls(xy[0], xy[1], _key(row), row.key, f"{row.log}@{row.t_s:.1f}s", *facts)


@dataclass(frozen=True)
class SceneMap:
    """All scenes on a plane, and the share of their variance that the plane shows."""

    points: list[MapPoint]
    share: float
    total: int


@dataclass(frozen=True)
class StatusMessage:
    """A line about a finished action."""

    message: str


@dataclass(frozen=True)
class SentScenes:
    """Scenes that the page shows or selects, as JSON."""

    keys: list[str]


@dataclass(frozen=True)
class SentTag:
    """A tag for scenes, as JSON."""

    keys: list[str]
    tag: str


@dataclass(frozen=True)
class SentClips:
    """Scenes that are to become clips, as JSON."""

    keys: list[str]
    before: float
    after: float
    """Time of a clip before and after the scene, s."""

    def __post_init__(self) -> None:
        for seconds in (self.before, self.after):
            if not 0 <= seconds < float("inf"):
                raise InputError(f"the times before and after must be numbers of 0 s or more, got {seconds}")


@dataclass(frozen=True)
class SentQuery:
    """A query that is to be saved, as JSON."""

    name: str
    asked: dict[str, str]


class SearchPage:
    """Serves the page by `server`.

    Args:
        towers: folder or name of the towers that made the index; by default as noted in the index.
        port: 0 takes any free port.

    Raises:
        InputError: the page cannot be served there.
    """

    def __init__(self, index: FrameIndex, towers: str | None, host: str, port: int) -> None:
        self._index, self._towers = index, towers
        self._one_at_a_time = threading.Lock()  # One query uses all cores
        answers: dict[tuple[str, str], Answer] = {
            ("GET", "/"): lambda _: Raw(page_html().encode(), "text/html; charset=utf-8"),
            ("GET", "/picture"): self._picture,
            ("GET", "/find"): self._find,
            ("GET", "/map"): lambda _: self._map(),
            ("GET", "/queries"): lambda _: saved_queries(self._index.uri),
            ("POST", "/moments"): self._moments,
            ("POST", "/tag"): self._tag,
            ("POST", "/clips"): self._clips,
            ("POST", "/queries"): self._save,
        }
        self.server = JsonServer(answers, host, port, MAX_BODY_BYTES, one_at_a_time=False)
        self.url = f"http://{host}:{self.server.address.port}"

    def _find(self, asked: Mapping[str, str]) -> ShownHits:
        query = query_of(asked)
        with self._one_at_a_time:
            result = ask(self._index, query, self._towers)
            notes = answer_notes(self._index, query, self._towers, result)
        how = "all compared" if result.exact else f"{result.compared} compared"
        what = "moments, no hits" if result.unlike else "hits"
        message = "; ".join([f"{len(result.hits)} {what}, {how}", *notes])
        return ShownHits([*map(ShownHit.of, result.hits)], message)

    def _map(self) -> SceneMap:
        plane = project_scenes(self._index)
        scenes = zip(plane.xy.tolist(), plane.rows, strict=True)
        return SceneMap([MapPoint.of(xy, row) for xy, row in scenes], plane.share, plane.total)

    def _picture(self, asked: Mapping[str, str]) -> Raw:
        (hit,) = self._rows([asked.get("key", "")])
        buffer = io.BytesIO()
        Image.fromarray(hit_picture(hit)).save(buffer, format="jpeg", quality=JPEG_QUALITY)
        return Raw(buffer.getvalue(), "image/jpeg")

    def _moments(self, body: object) -> ShownHits:
        sent: SentScenes = validated(SentScenes, body, "/moments")
        hits = self._rows(sent.keys[:MAX_SHOWN])
        return ShownHits([*map(ShownHit.of, hits)], f"{len(sent.keys)} scenes, {len(hits)} shown")

    def _tag(self, body: object) -> StatusMessage:
        sent: SentTag = validated(SentTag, body, "/tag")
        name = sent.tag.strip()
        if not name:
            raise InputError("a tag has a name")
        add_tag(self._index.uri, name, [_parse_key(key)[0] for key in sent.keys])
        return StatusMessage(f"{len(sent.keys)} moments are tagged {name}")

    def _clips(self, body: object) -> Mapping[str, object]:
        sent: SentClips = validated(SentClips, body, "/clips")
        return listed_clips(self._rows(sent.keys), sent.before, sent.after)

    def _save(self, body: object) -> StatusMessage:
        sent: SentQuery = validated(SentQuery, body, "/queries")
        save_query(self._index.uri, sent.name, query_of(sent.asked).to_json())
        return StatusMessage(f"saved as {sent.name}")

    def _rows(self, keys: Sequence[str]) -> list[Hit]:
        """Return the rows of some scenes, in their order, as hits without scores.

        Raises:
            InputError: none is named, or one is not in the index.
        """
        if not keys:
            raise InputError("nothing is selected")
        where = f"key IN ({quoted_list({_parse_key(key)[0] for key in keys})})"
        rows = {_key(row): row for row in IndexRow.all_of(self._index.select(where, FACTS.names))}
        if missing := [key for key in keys if key not in rows]:
            raise InputError(f"no scene {missing[0][:200]!r} in the index")
        return [Hit(rows[key], 0.0, {}) for key in keys]


def query_of(asked: Mapping[str, str]) -> Query:
    """Return the query of the page's fields; empty fields are left out.

    Raises:
        InputError: the fields make no valid query.
    """
    names = {field.name for field in fields(Query)}
    given = {name: value for name, value in asked.items() if name in names and value.strip()}
    # The fields of a URL are texts; validation converts numbers
    query: Query = validated(Query, given, "the query")
    if query.top > MAX_TOP:
        raise InputError(f"the page shows at most {MAX_TOP} hits")
    return query


@functools.cache
def page_html() -> str:
    """Return the page; it loads files only from this server."""
    return render_page("search_page.html.j2", title="Foredrive search")


def _key(row: IndexRow) -> str:
    return f"{row.key}|{row.view}"


def _parse_key(key: str) -> tuple[str, str]:
    """Return a moment's key and a view; together they identify a row."""
    moment, _, view = key.rpartition("|")
    return moment, view
