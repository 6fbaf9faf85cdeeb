"""A page that searches an index: a grid of hits, conditions, and a map of scenes with a lasso."""

import functools
import io
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from PIL import Image

from foredrive.errors import InputError
from foredrive.runs.search.searching import ask, listed_clips
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
MAX_BODY_BYTES = 2**20
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
Key = tuple[str, str]
"""A moment's key and a view; together they identify a row."""


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


class SearchPage:
    """Serves the page until it is closed.

    Args:
        towers: folder or name of the towers that made the index; by default as noted in the index.
        port: 0 takes any free port.
    """

    def __init__(self, index: FrameIndex, towers: str | None, host: str, port: int) -> None:
        self._index, self._towers = index, towers
        self._one_at_a_time = threading.Lock()  # one query uses all cores
        page = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if page._is_allowed(self):
                    page._answer(self, None)

            def do_POST(self) -> None:
                if page._is_allowed(self):
                    page._answer(self, self.rfile.read(int(self.headers["Content-Length"])))

            def log_message(self, format: str, *args: object) -> None:
                """Print nothing."""

        try:
            self._server = ThreadingHTTPServer((host, port), Handler)
        except OSError as error:
            raise InputError(f"{host}:{port}: no page can be served there: {error.strerror}") from error
        self.url = f"http://{host}:{self._server.server_address[1]}"

    def serve(self) -> None:
        """Answer requests in this thread until `close`."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def _is_allowed(self, request: BaseHTTPRequestHandler) -> bool:
        """Refuse requests that pages of other sites make through the user's browser, and long bodies.

        A page of another site has its own name in Origin. A name that its owner points to this machine (DNS
        rebinding) stands in Host.
        """
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        served = self._server.server_address[0]
        if served == "127.0.0.1" and host.rpartition(":")[0] not in LOOPBACK:
            _send_json(request, {"error": f"this page is not at {host}"}, HTTPStatus.FORBIDDEN)
        elif origin is not None and origin != f"http://{host}":
            _send_json(request, {"error": f"{origin} may not ask this page"}, HTTPStatus.FORBIDDEN)
        elif request.command == "GET":
            return True
        else:
            length = request.headers.get("Content-Length", "")
            if length.isascii() and length.isdigit() and int(length) <= MAX_BODY_BYTES:
                return True
            told = f"a request needs a Content-Length of at most {MAX_BODY_BYTES} bytes"
            request.close_connection = True  # its body is not read
            _send_json(request, {"error": told}, HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        return False

    def _answer(self, request: BaseHTTPRequestHandler, body: bytes | None) -> None:
        url = urlsplit(request.path)
        asked = {name: values[-1] for name, values in parse_qs(url.query).items()}
        get: dict[str, Callable[[Mapping[str, str]], Any]] = {
            "/find": self._find,
            "/map": self._map,
            "/queries": lambda _: saved_queries(self._index.uri),
        }
        post: dict[str, Callable[[Any], Any]] = {
            "/moments": self._moments,
            "/tag": self._tag,
            "/clips": self._clips,
            "/queries": self._save,
        }
        try:
            if body is None and url.path == "/":
                return _send(request, "text/html; charset=utf-8", page_html().encode())
            if body is None and url.path == "/picture":
                return _send(request, "image/jpeg", self._picture(asked))
            if body is None and url.path in get:
                return _send_json(request, get[url.path](asked))
            if body is not None and url.path in post:
                return _send_json(request, post[url.path](json.loads(body)))
            _send_json(request, {"error": f"{url.path}: no such page"}, HTTPStatus.NOT_FOUND)
        except (InputError, ValueError, LookupError, TypeError, RecursionError) as error:
            _send_json(request, {"error": " ".join(str(error).split())}, HTTPStatus.BAD_REQUEST)

    def _find(self, asked: Mapping[str, str]) -> ShownHits:
        query = query_of(asked)
        with self._one_at_a_time:
            found = ask(self._index, query, self._towers)
        how = "all compared" if found.exact else f"{found.compared} compared"
        return ShownHits([*map(ShownHit.of, found.hits)], f"{len(found.hits)} hits, {how}")

    def _map(self, _: Mapping[str, str]) -> SceneMap:
        plane = project_scenes(self._index)
        scenes = zip(plane.xy.tolist(), plane.rows, strict=True)
        return SceneMap([MapPoint.of(xy, row) for xy, row in scenes], plane.share, plane.total)

    def _picture(self, asked: Mapping[str, str]) -> bytes:
        (hit,) = self._rows([_parse_key(asked["key"])])
        buffer = io.BytesIO()
        Image.fromarray(hit_picture(hit)).save(buffer, format="jpeg", quality=JPEG_QUALITY)
        return buffer.getvalue()

    def _moments(self, body: Mapping[str, Any]) -> ShownHits:
        hits = self._rows([_parse_key(key) for key in body["keys"][:MAX_SHOWN]])
        return ShownHits([*map(ShownHit.of, hits)], f"{len(body['keys'])} scenes, {len(hits)} shown")

    def _tag(self, body: Mapping[str, Any]) -> StatusMessage:
        name = str(body["tag"]).strip()
        if not name:
            raise InputError("a tag has a name")
        add_tag(self._index.uri, name, [_parse_key(key)[0] for key in body["keys"]])
        return StatusMessage(f"{len(body['keys'])} moments are tagged {name}")

    def _clips(self, body: Mapping[str, Any]) -> Mapping[str, object]:
        hits = self._rows([_parse_key(key) for key in body["keys"]])
        return listed_clips(hits, float(body["before"]), float(body["after"]))

    def _save(self, body: Mapping[str, Any]) -> StatusMessage:
        save_query(self._index.uri, str(body["name"]), query_of(body["asked"]).to_json())
        return StatusMessage(f"saved as {body['name']}")

    def _rows(self, keys: Sequence[Key]) -> list[Hit]:
        """Return the rows of some keys, in their order, as hits without scores."""
        if not keys:
            raise InputError("nothing is selected")
        where = f"key IN ({quoted_list({moment for moment, _ in keys})})"
        rows = {_key(row): row for row in IndexRow.all_of(self._index.select(where, FACTS.names))}
        return [Hit(rows["|".join(key)], 0.0, {}) for key in keys]


def query_of(asked: Mapping[str, Any]) -> Query:
    """Return the query of the page's fields; empty fields are left out.

    Raises:
        InputError: the fields make no valid query.
    """
    kinds: dict[str, Callable[[Any], Any]] = {"top": int, "gap_s": float, "mix": float}
    known = {field.name for field in fields(Query)}
    given = {name: value for name, value in asked.items() if name in known and str(value).strip()}
    return Query(**{name: kinds.get(name, str)(value) for name, value in given.items()})


@functools.cache
def page_html() -> str:
    """Return the page; it loads files only from this server."""
    return render_page("search_page.html.j2", title="Foredrive search")


def _key(row: IndexRow) -> str:
    return f"{row.key}|{row.view}"


def _parse_key(key: str) -> Key:
    moment, _, view = key.rpartition("|")
    return moment, view


def _send_json(request: BaseHTTPRequestHandler, content: object, status: HTTPStatus = HTTPStatus.OK) -> None:
    _send(request, "application/json", json.dumps(content, default=asdict).encode(), status)


def _send(
    request: BaseHTTPRequestHandler, kind: str, body: bytes, status: HTTPStatus = HTTPStatus.OK
) -> None:
    request.send_response(status)
    request.send_header("Content-Type", kind)
    request.send_header("Content-Length", str(len(body)))
    request.send_header("X-Content-Type-Options", "nosniff")
    request.end_headers()
    request.wfile.write(body)
