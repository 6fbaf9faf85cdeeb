"""JSON over HTTP, bounded in size and time: one call of a client, and a server of plain functions.

The standard library has both ends. It bounds neither the size of an answer nor the time of a whole call.
"""

import contextlib
import json
import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from email.message import Message
from http.client import HTTPConnection, HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BufferedIOBase
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pydantic import TypeAdapter, ValidationError

from foredrive.errors import InputError

ANSWER_S = 60.0
"""Time in which a server has to answer, s, if its address does not say otherwise."""
LOOPBACK = "127.0.0.1"
MAX_REQUEST_BYTES = 2**28
"""Largest body of a request. Six uncompressed images of 1600 x 900 px take 35 MB."""
MAX_ANSWER_BYTES = 2**26
CONNECTIONS = 8
"""Largest number of requests that a server reads at the same time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Address of a server, and the time in which it has to answer a call."""

    host: str
    port: int
    answer_s: float = ANSWER_S

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


def read_address(url: str, scheme: str = "http") -> Address:
    """Read SCHEME://HOST:PORT, optionally with ?timeout=SECONDS.

    Raises:
        InputError: the text is no such address.
    """
    problem = InputError(f"{url}: not an address of the form {scheme}://HOST:PORT[?timeout=SECONDS]")
    try:
        parts = urlsplit(url)
        options = parse_qs(parts.query, strict_parsing=bool(parts.query))
        host, port = parts.hostname, parts.port
        answer_s = float(options.pop("timeout", [str(ANSWER_S)])[0])
    except ValueError:
        raise problem from None
    if parts.scheme != scheme or not host or not port or options or parts.path not in ("", "/"):
        raise problem
    if not 0 < answer_s <= threading.TIMEOUT_MAX:
        raise InputError(f"{url}: the timeout must be above 0 s")
    return Address(host, port, answer_s)


def ask(address: Address, path: str, body: object = None, *, max_bytes: int = MAX_ANSWER_BYTES) -> Any:
    """Return the JSON that a server answers: to a POST of `body`, to a GET if it is None.

    Raises:
        InputError: there is no answer in time, it is an error, too long, or not JSON.
    """
    began, where = time.monotonic(), f"http://{address}{path}"
    late = InputError(f"{where}: no answer within {address.answer_s:g} s")
    connection = HTTPConnection(address.host, address.port, timeout=address.answer_s)
    try:
        with _cut_after(connection, began + address.answer_s):
            if body is None:
                connection.request("GET", path)
            else:
                content = json.dumps(body).encode()
                connection.request("POST", path, content, {"Content-Type": "application/json"})
            answer = connection.getresponse()
            read = answer.read(max_bytes + 1)
    except TimeoutError as error:
        raise late from error
    except (OSError, HTTPException) as error:
        if time.monotonic() - began >= address.answer_s:
            raise late from error
        raise InputError(f"{where}: no answer: {_one_line(error)}") from error
    finally:
        connection.close()
    if time.monotonic() - began >= address.answer_s:
        raise late
    if len(read) > max_bytes:
        raise InputError(f"{where}: the answer is longer than {max_bytes:,} bytes")
    if answer.status != 200:
        raise InputError(f"{where}: error {answer.status}: {_one_line(read.decode(errors='replace'))}")
    try:
        return json.loads(read)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: the answer is not JSON: {_one_line(error)}") from error


def _one_line(told: object) -> str:
    return " ".join(str(told).split())[:300] or type(told).__name__


@contextlib.contextmanager
def _cut_after(connection: HTTPConnection, at_s: float) -> Iterator[None]:
    """Connect, and close the connection at a time: a server that sends byte by byte is never silent."""
    connection.connect()
    opened = connection.sock

    def cut() -> None:
        with contextlib.suppress(OSError):
            opened.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(max(0.0, at_s - time.monotonic()), cut)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@dataclass(frozen=True)
class Raw:
    """An answer that is not JSON."""

    content: bytes
    media_type: str


Answer = Callable[[Any], object]
"""Returns the answer to the JSON of a request (None for a GET): a value for JSON, or `Raw`. An InputError is
answered as error 422 with its message."""


class JsonServer:
    """HTTP server of functions by method and path. They run one at a time.

    Raises:
        InputError: the address cannot be served.
    """

    def __init__(
        self,
        answers: Mapping[tuple[str, str], Answer],
        host: str = LOOPBACK,
        port: int = 0,
        max_bytes: int = MAX_REQUEST_BYTES,
    ) -> None:
        handler = _handler(answers, threading.Lock(), threading.BoundedSemaphore(CONNECTIONS), max_bytes)
        try:
            self._server = ThreadingHTTPServer((host, port), handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"{host}:{port} cannot be served: {error}") from error
        self._server.daemon_threads = True

    @property
    def address(self) -> Address:
        """Return the address; its port is the one that was found if 0 was asked for."""
        host, port = self._server.server_address[:2]
        return Address(str(host), int(port))

    def serve(self) -> None:
        """Answer requests until the server is closed or interrupted."""
        self._server.serve_forever(poll_interval=0.1)

    @contextlib.contextmanager
    def in_background(self) -> Iterator[Address]:
        """Answer requests in a thread while the context lasts."""
        thread = threading.Thread(target=self.serve, daemon=True)
        thread.start()
        try:
            yield self.address
        finally:
            self._server.shutdown()
            thread.join()
            self.close()

    def close(self) -> None:
        """Give up the port."""
        self._server.server_close()


def _handler(
    answers: Mapping[tuple[str, str], Answer],
    one_at_a_time: threading.Lock,
    open_requests: threading.BoundedSemaphore,
    max_bytes: int,
) -> type[BaseHTTPRequestHandler]:
    """Return the class that handles the requests of one server."""

    class Handler(BaseHTTPRequestHandler):
        timeout = ANSWER_S

        def do_GET(self) -> None:
            self._respond()

        def do_POST(self) -> None:
            self._respond()

        def log_message(self, format: str, *args: Any) -> None:
            _log.debug(format, *args)

        def _respond(self) -> None:
            if not open_requests.acquire(blocking=False):
                self._send(503, _detail("too many requests at a time"))
                return
            try:
                self._send(*self._answered())
            finally:
                open_requests.release()

        def _answered(self) -> tuple[int, Raw]:
            foreign = _foreign(self.headers, self.server.server_address)
            if foreign is not None:
                self.close_connection = True  # its body is not read
                return 403, _detail(foreign)
            path = self.path.partition("?")[0]
            answer = answers.get((self.command, path))
            if answer is None:
                known = ", ".join(" ".join(each) for each in answers)
                return 404, _detail(f"no {self.command} {path}; there are: {known}")
            try:
                body = _body(self.headers, self.rfile, max_bytes) if self.command == "POST" else None
                with one_at_a_time:
                    value = answer(body)
            except InputError as error:
                return 422, _detail(str(error))
            except Exception:
                _log.exception("%s failed", path)
                return 500, _detail("internal error")
            return 200, value if isinstance(value, Raw) else _json(value)

        def _send(self, status: int, answer: Raw) -> None:
            with contextlib.suppress(OSError):  # the client has gone
                self.send_response(status)
                self.send_header("Content-Type", answer.media_type)
                self.send_header("Content-Length", str(len(answer.content)))
                self.end_headers()
                self.wfile.write(answer.content)

    return Handler


def _foreign(headers: Message, address: object) -> str | None:
    """Return why a request is not answered that a page of another site makes through a browser.

    Such a page has its own name in Origin. A name that its owner points to this machine (DNS rebinding)
    stands in Host.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    is_local = isinstance(address, tuple) and address[0] == LOOPBACK
    if is_local and host and host.partition(":")[0] not in (LOOPBACK, "localhost"):
        return f"this server is not at {host[:100]}"
    if origin is not None and origin != f"http://{host}":
        return f"{origin[:100]} may not ask this server"
    return None


def _body(headers: Message, content: BufferedIOBase, max_bytes: int) -> Any:
    """Read the JSON of a request.

    Raises:
        InputError: it has no length or too large a one, is of another type, or not JSON.
    """
    length = headers.get("Content-Length", "")
    if not length.isascii() or not length.isdecimal():
        raise InputError("a request needs a Content-Length")
    if len(length) > 12 or int(length) > max_bytes:
        raise InputError(f"a request may have {max_bytes:,} bytes, not {length[:20]}")
    if headers.get_content_type() != "application/json":  # a page in a browser cannot send it
        raise InputError("a request has to be application/json")
    try:
        return json.loads(content.read(int(length)))
    except (ValueError, RecursionError, OSError) as error:
        raise InputError(f"the request is not JSON: {_one_line(error)}") from error


def _json(value: object) -> Raw:
    return Raw(json.dumps(value).encode(), "application/json")


def _detail(message: str) -> Raw:
    return _json({"detail": message})


def validated(kind: Any, body: object, what: str) -> Any:
    """Return a JSON value as a dataclass.

    Raises:
        InputError: the value does not fit. The message names the entry.
    """
    try:
        return TypeAdapter(kind).validate_python(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{what}: {f'{where}: ' if where else ''}{first['msg']}") from error
