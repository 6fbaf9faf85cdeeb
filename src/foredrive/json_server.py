"""A server of plain functions: JSON over HTTP, bounded in size, time and connections."""

import contextlib
import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from email.message import Message
from typing import Any
from urllib.parse import parse_qsl

from pydantic import TypeAdapter, ValidationError

from foredrive.bounded_server import BoundedHandler, BoundedServer, refusal
from foredrive.errors import InputError

ANSWER_S = 60.0
"""Time in which a server has to answer, s, if its address does not say otherwise."""
MAX_REQUEST_BYTES = 2**26
"""Largest body of a request. Six uncompressed images of 1600 x 900 px take 35 MB."""
BODIES = 4
"""Bodies of the largest size that a server holds at the same time."""
MAX_VALUES = 2**22
"""Largest number of values in a request. Python keeps 60 bytes for a value that takes 3 in JSON."""
MAX_FIELDS = 100
"""Largest number of fields in the query of a URL."""
LOOPBACK = "127.0.0.1"

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Address of a server, and the time in which it has to answer a call."""

    host: str
    port: int
    answer_s: float = ANSWER_S

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


@dataclass(frozen=True)
class Raw:
    """An answer that is not JSON."""

    content: bytes
    media_type: str


Answer = Callable[[Any], object]
"""Returns the answer to the JSON of a POST, or to the fields in the URL of a GET: a value for JSON (may hold
dataclasses), or `Raw`. An InputError is answered as error 422 with its message."""


class JsonServer:
    """HTTP server of functions by method and path.

    Args:
        answers: the functions.
        host, port: where it listens; port 0 takes any that is free.
        max_bytes: size of the largest body of a request.
        one_at_a_time: whether the functions run one after the other. Otherwise they are called from several
            threads.

    Raises:
        InputError: the address cannot be served.
    """

    def __init__(
        self,
        answers: Mapping[tuple[str, str], Answer],
        host: str = LOOPBACK,
        port: int = 0,
        max_bytes: int = MAX_REQUEST_BYTES,
        *,
        one_at_a_time: bool = True,
    ) -> None:
        turn = threading.Lock() if one_at_a_time else contextlib.nullcontext()
        try:
            self._server = BoundedServer((host, port), _handler(answers, turn, max_bytes), BODIES * max_bytes)
        except (OSError, OverflowError) as error:
            raise InputError(f"{host}:{port} cannot be served: {error}") from error

    @property
    def address(self) -> Address:
        """Return the address. Its port is the one that the operating system chose if port 0 was requested."""
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
        """Release the port."""
        self._server.server_close()


def _handler(
    answers: Mapping[tuple[str, str], Answer],
    turn: contextlib.AbstractContextManager[Any],
    max_bytes: int,
) -> type[BoundedHandler]:
    """Return the class that handles the requests of one server."""

    class Handler(BoundedHandler):
        def do_GET(self) -> None:
            self._respond()

        def do_POST(self) -> None:
            self._respond()

        def _respond(self) -> None:
            status, answer = self._answered()
            self.send(status, answer.content, answer.media_type)

        def _answered(self) -> tuple[int, Raw]:
            foreign = refusal(self.headers, str(self.server.server_address[0]))
            if foreign is not None:
                return 403, _detail(foreign)
            path, _, query = self.path.partition("?")
            answer = answers.get((self.command, path))
            if answer is None:
                served = ", ".join(" ".join(key) for key in answers)
                return 404, _detail(f"no {self.command} {path[:100]}; there are: {served}")
            try:
                # The body is read before its turn: a slow client does not hold up the others
                body = b"" if self.command == "GET" else self.read_body(_length(self.headers, max_bytes))
                # A request that waits for its turn is not closed for another connection
                with self.server.working_for(self.connection), turn:
                    return 200, _content(answer(_fields(query) if self.command == "GET" else _values(body)))
            except InputError as error:
                return 422, _detail(str(error))
            except (ConnectionError, TimeoutError):  # The client has disconnected, or is too slow
                raise
            except Exception:
                _log.exception("%s failed", path)
                return 500, _detail("internal error")

    return Handler


def _fields(query: str) -> dict[str, str]:
    """Return the fields of a URL; of several with one name, the last.

    Raises:
        InputError: there are too many.
    """
    try:
        return dict(parse_qsl(query, max_num_fields=MAX_FIELDS))
    except ValueError as error:
        raise InputError(f"the address cannot be read: {error}") from error


def _length(headers: Message, max_bytes: int) -> int:
    """Return the length of a body of JSON.

    Raises:
        InputError: it is missing or too large, or the body is of another type.
    """
    length = headers.get("Content-Length", "")
    if not length.isascii() or not length.isdecimal():
        raise InputError("a request needs a Content-Length")
    # The number of digits is checked first: Python converts long numbers in quadratic time
    if len(length) > 12 or int(length) > max_bytes:
        raise InputError(f"a request may have {max_bytes:,} bytes, not {length[:20]}")
    # A page of another site can send forms and plain text through a browser, but not this type
    if headers.get_content_type() != "application/json":
        raise InputError("a request has to be application/json")
    return int(length)


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
        why = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{what}: {f'{where[:100]}: ' if where else ''}{why}") from error
