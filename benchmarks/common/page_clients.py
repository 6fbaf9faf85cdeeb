"""Clients of the search page and of the viewer, each in a thread of its own, as many browsers would be."""

import contextlib
import json
import random
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
import viser
import zstandard
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection

TEXTS = ("car", "pedestrian crossing", "a van ahead", "empty street", "traffic light", "parked vehicles")
ANSWER_S, START_S = 60.0, 300.0
THINKS_S = 5.0
"""Mean time between two requests of a client."""
FRAMES_A_VISIT = 40
"""Messages after which a browser reloads the page of a log."""


class Clients:
    """Threads that visit a page until the block ends. They wait for the page to be served.

    Args:
        visit: makes requests of client `n` with its own random numbers; returns whether all were answered.
    """

    def __init__(self, port: int, clients: int, seed: int) -> None:
        self.port, self.counts = port, Counter[str](requests=0, failed=0, clients=clients)
        self._stop, self._lock = threading.Event(), threading.Lock()
        self._threads = [
            threading.Thread(target=self._work, args=(n, random.Random(seed * 1000 + n)), daemon=True)
            for n in range(clients)
        ]

    def visit(self, client: int, draw: random.Random) -> None:
        """Visit the page once."""
        raise NotImplementedError

    def count(self, name: str, number: int = 1) -> None:
        """Add to a figure."""
        with self._lock:
            self.counts[name] += number

    def wait(self, draw: random.Random) -> None:
        """Wait as a user does."""
        self._stop.wait(draw.uniform(0.5, 1.5) * THINKS_S)

    @property
    def stopped(self) -> bool:
        """Return whether the clients have to end."""
        return self._stop.is_set()

    def __enter__(self) -> "Clients":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(ANSWER_S)

    def _work(self, client: int, draw: random.Random) -> None:
        began_s, served = time.monotonic(), False
        while not self.stopped:
            try:
                self.visit(client, draw)
                served = True
            except (OSError, WebSocketException, urllib.error.URLError) as error:
                if served or time.monotonic() - began_s > START_S:
                    self.count("failed")
                    if self.counts["failed"] < 10:
                        print(f"client {client}: {type(error).__name__}: {error}")
            self.wait(draw)


class SearchClients(Clients):
    """Clients that open the search page, search, look at pictures, ask for the map, and tag."""

    def visit(self, client: int, draw: random.Random) -> None:
        """Ask one thing."""
        asked: dict[str, Callable[[], Any]] = {
            "page": lambda: self._get("/"),
            "map": lambda: self._get("/map"),
            "tag": lambda: self._tag(draw),
        }
        kind = draw.choices(["find", *asked], weights=[20, 4, 1, 1])[0]
        if kind != "find":
            asked[kind]()
            return
        view = draw.choice(("all", "sectors"))
        hits = self._find(text=draw.choice(TEXTS), top=draw.randint(3, 24), gap_s=0, view=view)
        for hit in draw.sample(hits, min(3, len(hits))):
            self._get("/picture", {"key": hit["key"]})

    def _find(self, **asked: object) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads(self._get("/find", asked))["hits"]
        return found

    def _tag(self, draw: random.Random) -> None:
        keys = [hit["key"] for hit in self._find(text=draw.choice(TEXTS), top=2)]
        body = json.dumps({"tag": draw.choice(("seen", "later")), "keys": keys}).encode()
        self._get("/tag", body=body)

    def _get(
        self, path: str, query: Mapping[str, object] | None = None, *, body: bytes | None = None
    ) -> bytes:
        url = f"http://127.0.0.1:{self.port}{path}?{urllib.parse.urlencode(query or {})}"
        headers = {"Content-Type": "application/json"}
        with urllib.request.urlopen(urllib.request.Request(url, body, headers), timeout=ANSWER_S) as answer:
            read: bytes = answer.read()
        self.count("requests")
        return read


class ViewerClients(Clients):
    """Browsers that open the page of a log, move its slider and layers, and reload."""

    def visit(self, client: int, draw: random.Random) -> None:
        """Open the page, follow it for a while, and close it."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/", timeout=ANSWER_S) as page:
            page.read()
        self.count("requests")
        where = f"ws://127.0.0.1:{self.port}"
        with connect(where, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as connection:  # type: ignore[list-item]
            sliders = dict[str, tuple[str, int]]()
            _send(connection, "ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(-20.0, 0.0, 15.0),
                  fov=1.0, near=0.1, far=1000.0, image_height=600, image_width=800, look_at=(0.0, 0.0, 0.0),
                  up_direction=(0.0, 0.0, 1.0))  # fmt: skip
            for _ in range(FRAMES_A_VISIT):
                if self.stopped:
                    return
                self._follow(connection, sliders, draw)
                if "frame" in sliders:
                    uuid, last = sliders["frame"]
                    _send(connection, "GuiUpdateMessage", uuid=uuid, updates={"value": draw.randint(0, last)})
                    self.count("requests")

    def _follow(
        self, connection: Connection, sliders: dict[str, tuple[str, int]], draw: random.Random
    ) -> None:
        """Receive messages for some seconds; note the sliders."""
        until_s = time.monotonic() + draw.uniform(0.5, 1.5) * THINKS_S
        while (left_s := until_s - time.monotonic()) > 0 and not self.stopped:
            with contextlib.suppress(TimeoutError):
                received = connection.recv(timeout=left_s)
                assert isinstance(received, bytes)
                self.count("received_bytes", len(received))
                if "frame" not in sliders:
                    window = zstandard.ZstdDecompressor().decompressobj().decompress(received[8:])
                    for message in msgspec.msgpack.decode(window)["messages"]:
                        if message["type"] == "GuiSliderMessage":
                            props = message["props"]
                            sliders[props["label"]] = (message["uuid"], int(props["max"]))


def _send(connection: Connection, kind: str, **fields: object) -> None:
    connection.send(msgspec.msgpack.encode({"type": kind, **fields}))
