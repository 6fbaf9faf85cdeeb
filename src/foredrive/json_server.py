"""A server of plain functions: JSON over HTTP, bounded in size, time and connections.

aiohttp bounds neither the number of connections nor the time of a client. Here, the connection that has kept
the server waiting longest is closed at the limit, to make room for the next one. A client that sends its
request without delay is therefore answered, however many slow clients there are.
"""

import asyncio
import contextlib
import json
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import asdict, dataclass
from typing import Any

from aiohttp import web
from fsspec.asyn import get_loop, sync

from foredrive.errors import InputError
from foredrive.json_http import MAX_CONNECTIONS, REQUEST_S, Address, refusal

SEND_S = 60.0
"""Time in which a client has to take the whole answer, s."""
MAX_REQUEST_BYTES = 2**26
"""Largest body of a request. Six uncompressed images of 1600 x 900 px take 35 MB."""
BODIES = 4
"""Bodies of the largest size that a server holds at the same time."""
MAX_VALUES = 2**22
"""Largest number of values in a request. Python keeps 60 bytes for a value that takes 3 in JSON."""
BACKLOG = 512
"""Connections that the operating system keeps until they are accepted. Others try again after a second."""

_BUSY = b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_log = logging.getLogger(__name__)
# A request that is no HTTP is an error of the client and not worth a line
_log.addFilter(lambda record: not str(record.msg).startswith("Error handling request"))


@dataclass(frozen=True)
class Raw:
    """An answer that is not JSON."""

    content: bytes
    media_type: str


Answer = Callable[[Any], object]
"""Returns the answer to the JSON of a POST, or to the fields in the URL of a GET: a value for JSON (may hold
dataclasses), or `Raw`. An InputError is answered as error 422 with its message."""


class JsonServer:
    """HTTP server of functions by method and path. Each request is answered in a thread of its own.

    Args:
        answers: the functions.
        host, port: where it listens; port 0 takes any that is free.
        max_bytes: size of the largest body of a request.
        one_at_a_time: whether the functions run one after the other.

    Raises:
        InputError: the address cannot be served.
    """

    def __init__(
        self,
        answers: Mapping[tuple[str, str], Answer],
        host: str = "127.0.0.1",
        port: int = 0,
        max_bytes: int = MAX_REQUEST_BYTES,
        *,
        one_at_a_time: bool = True,
    ) -> None:
        self._answers, self._max_bytes = answers, max_bytes
        self._turn = threading.Lock() if one_at_a_time else contextlib.nullcontext()
        try:
            self._socket = socket.create_server((host, port))
        except (OSError, OverflowError) as error:
            raise InputError(f"{host}:{port} cannot be served: {error}") from error
        self.address = Address(*self._socket.getsockname()[:2])
        """Its port is the one that the operating system chose if port 0 was requested."""

    def serve(self) -> None:
        """Answer requests until the server is interrupted."""
        with self.in_background():
            threading.Event().wait()

    @contextlib.contextmanager
    def in_background(self) -> Iterator[Address]:
        """Answer requests in a thread while the context lasts. Its end releases the port."""
        sync(get_loop(), self._start)
        try:
            yield self.address
        finally:
            sync(get_loop(), self._stop)

    async def _start(self) -> None:
        self._clients = _Clients(self._respond, BODIES * self._max_bytes)
        loop = asyncio.get_running_loop()
        self._listening = await loop.create_server(self._clients, sock=self._socket, backlog=BACKLOG)

    async def _stop(self) -> None:
        self._listening.close()
        for handler in self._clients.connections:
            self._clients.drop(handler)

    async def _respond(self, request: web.BaseRequest) -> web.StreamResponse:
        status, answer = await self._answered(request)
        headers = {"Content-Type": answer.media_type, "X-Content-Type-Options": "nosniff"}
        response = web.Response(status=status, body=answer.content, headers=headers)
        response.force_close()  # A connection has one request
        self._clients.wait_for(request.protocol, SEND_S)
        return response

    async def _answered(self, request: web.BaseRequest) -> tuple[int, Raw]:
        foreign = refusal(request.headers, self.address.host)
        if foreign is not None:
            return 403, _detail(foreign)
        answer = self._answers.get((request.method, request.path))
        if answer is None:
            served = ", ".join(" ".join(key) for key in self._answers)
            return 404, _detail(f"no {request.method} {request.path[:100]}; there are: {served}")

        def work(body: bytes | None) -> Raw:
            with self._turn:
                return _content(answer(dict(request.query.items()) if body is None else _values(body)))

        try:
            # The body is read before its turn: a slow client does not hold up the others
            body = None if request.method == "GET" else await self._read(request)
            # A request that waits for its turn is not closed for another connection
            self._clients.work_for(request.protocol)
            return 200, await _in_thread(lambda: work(body))
        except InputError as error:
            return 422, _detail(str(error))
        except (ConnectionError, TimeoutError):  # The client has disconnected
            raise
        except Exception:
            _log.exception("%s failed", request.path)
            return 500, _detail("internal error")

    async def _read(self, request: web.BaseRequest) -> bytes:
        """Return the body of a request. Memory is allocated only for the bytes that have arrived.

        Raises:
            InputError: its length is missing or too large, or it is of another type than JSON.
        """
        length = request.content_length
        if length is None:
            raise InputError("a request needs a Content-Length")
        if length > self._max_bytes:
            raise InputError(f"a request may have {self._max_bytes:,} bytes, not {length}")
        # A page of another site can send forms and plain text through a browser, but not this type
        if request.content_type != "application/json":
            raise InputError("a request has to be application/json")
        body = bytearray()
        async for part in request.content.iter_any():
            body += part
            self._clients.hold(request.protocol, len(body))
        return bytes(body)


class _Clients(web.Server):
    """The connections of a server.

    Args:
        handler: answers a request.
        max_bytes: size of all bodies of requests that are held at the same time.
    """

    def __init__(self, handler: Callable[[web.BaseRequest], Any], max_bytes: int) -> None:
        # A compressed body would be larger than its length says
        super().__init__(handler, logger=_log, access_log=None, auto_decompress=False, max_line_size=2**16)
        self._max_bytes = max_bytes
        self._held_bytes = dict[web.RequestHandler, int]()
        """All open connections, and the size of the body that has arrived on each."""
        self._waited_for = dict[web.RequestHandler, asyncio.TimerHandle]()
        """Connections on whose client the server waits, those that have kept it waiting longest first."""

    def connection_made(self, handler: web.RequestHandler, transport: asyncio.Transport) -> None:
        """Accept a connection; close another one for it if there are too many, or refuse it."""
        super().connection_made(handler, transport)
        if len(self._held_bytes) >= MAX_CONNECTIONS and not self._drop_longest_waited_for():
            transport.write(_BUSY)
            handler.force_close()
            return
        self._held_bytes[handler] = 0
        self.wait_for(handler, REQUEST_S)

    def connection_lost(self, handler: web.RequestHandler, exc: BaseException | None = None) -> None:
        """Forget a connection."""
        super().connection_lost(handler, exc)
        self.drop(handler)

    def wait_for(self, handler: web.RequestHandler, limit_s: float) -> None:
        """Close a connection after some time, or earlier for another one."""
        self.work_for(handler)
        self._waited_for[handler] = self._loop.call_later(limit_s, self.drop, handler)

    def work_for(self, handler: web.RequestHandler) -> None:
        """Keep a connection from being closed.

        Raises:
            ConnectionAbortedError: it has been closed before.
        """
        if handler not in self._held_bytes:
            raise ConnectionAbortedError
        if handler in self._waited_for:
            self._waited_for.pop(handler).cancel()

    def hold(self, handler: web.RequestHandler, size: int) -> None:
        """Note how much of a body has arrived; close connections if all bodies together are too large.

        Raises:
            ConnectionAbortedError: this connection has been closed.
        """
        if handler in self._held_bytes:
            self._held_bytes[handler] = size
        while sum(self._held_bytes.values()) > self._max_bytes and self._drop_longest_waited_for():
            pass
        if handler not in self._held_bytes:
            raise ConnectionAbortedError

    def _drop_longest_waited_for(self) -> bool:
        handler = next(iter(self._waited_for), None)
        if handler is not None:
            self.drop(handler)
        return handler is not None

    def drop(self, handler: web.RequestHandler) -> None:
        """Close a connection at once."""
        self._held_bytes.pop(handler, None)
        if handler in self._waited_for:
            self._waited_for.pop(handler).cancel()
        if handler.transport is not None:
            handler.transport.abort()  # `close` would wait until the client has taken what was sent


async def _in_thread(work: Callable[[], Raw]) -> Raw:
    """Return what a function returns in a daemon thread, which unlike asyncio's does not delay Ctrl-C."""
    future = Future[Raw]()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return await asyncio.wrap_future(future)


def _values(body: bytes) -> Any:
    """Return the JSON of a request.

    Raises:
        InputError: it is not JSON, or has too many values.
    """
    # Each value but the first follows one of these characters. Characters in strings count too
    if sum(map(body.count, (b",", b"[", b"{"))) > MAX_VALUES:
        raise InputError(f"a request may have {MAX_VALUES:,} values")
    try:
        return json.loads(body)
    except (ValueError, RecursionError) as error:
        raise InputError(f"the request is not JSON: {' '.join(str(error).split())[:300]}") from error


def _content(value: object) -> Raw:
    if isinstance(value, Raw):
        return value
    return Raw(json.dumps(value, default=asdict).encode(), "application/json")


def _detail(message: str) -> Raw:
    return _content({"detail": " ".join(message.split())})
