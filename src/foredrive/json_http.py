"""JSON over HTTP: addresses, calls that are bounded in size and time, and which requests servers accept."""

import io
import json
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qs, urlsplit

from pydantic import TypeAdapter, ValidationError

from foredrive.errors import InputError

MAX_CONNECTIONS = 128
"""Largest number of open connections of a server. A browser opens six."""
REQUEST_S = 30.0
"""Time in which a client has to send its whole request, s."""
ANSWER_S = 60.0
"""Time in which a server has to answer, s, if its address does not say otherwise."""
MAX_ANSWER_BYTES = 2**26
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


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
    import aiohttp  # 0.3 s
    from fsspec.asyn import get_loop, sync
    from yarl import URL

    where = f"http://{address}{path}"
    url = URL.build(scheme="http", host=address.host, port=address.port, path=path)
    content = None if body is None else json.dumps(body).encode()

    async def call() -> tuple[int, bytes]:
        async with (
            # The time is that of the whole call: a server that sends byte by byte is never silent
            aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(address.answer_s)) as session,
            session.request(
                "GET" if content is None else "POST",
                url,
                data=None if content is None else io.BytesIO(content),
                headers={"Content-Type": "application/json", "Accept-Encoding": "identity"},
                allow_redirects=False,
            ) as answer,
        ):
            read = bytearray()
            async for part in answer.content.iter_any():
                read += part
                if len(read) > max_bytes:
                    raise InputError(f"{where}: the answer is longer than {max_bytes:,} bytes")
            return answer.status, bytes(read)

    try:
        status, read = sync(get_loop(), call)
    except TimeoutError as error:
        raise InputError(f"{where}: no answer within {address.answer_s:g} s") from error
    except (OSError, aiohttp.ClientError) as error:
        raise InputError(f"{where}: no answer: {_one_line(error)}") from error
    if status != 200:
        raise InputError(f"{where}: error {status}: {_one_line(read.decode(errors='replace'))}")
    try:
        return json.loads(read)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: the answer is not JSON: {_one_line(error)}") from error


def _one_line(text: object) -> str:
    return " ".join(str(text).split())[:300] or type(text).__name__


def refusal(headers: Mapping[str, str], host: str) -> str | None:
    """Return why a request is refused that a browser sends for a page of another site; None: it is allowed.

    The Origin header of such a request names the other site. With DNS rebinding, a name of the other site
    resolves to this machine; then the Host header holds that name.

    Args:
        headers: the request's headers.
        host: address at which the server listens.
    """
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    name = asked if asked.endswith("]") else asked.rpartition(":")[0] or asked
    if host in LOOPBACK and asked and name not in LOOPBACK:
        return f"this server is not at {asked[:100]}"
    if origin is not None and origin.partition("://")[2] != asked:
        return f"{origin[:100]} may not ask this server"
    return None


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
