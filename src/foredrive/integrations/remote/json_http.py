"""A call of a JSON server, bounded in size and time.

The standard library bounds neither the size of an answer nor the time of a whole call.
"""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPException
from typing import Any
from urllib.parse import parse_qs, urlsplit

from foredrive.errors import InputError
from foredrive.json_server import ANSWER_S, Address

MAX_ANSWER_BYTES = 2**26


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


def _one_line(text: object) -> str:
    return " ".join(str(text).split())[:300] or type(text).__name__


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
