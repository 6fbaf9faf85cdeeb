"""JSON over real loopback sockets: every way in which a server does not answer."""

import contextlib
import socket
import threading
import time
from collections.abc import Iterator

import pytest

from foredrive.errors import InputError
from foredrive.json_http import Address, ask, read_address


def is_length(line: bytes) -> bool:
    return line.lower().startswith(b"content-length:")


@contextlib.contextmanager
def raw_server(*chunks: bytes, gap_s: float = 0.0, answer_s: float = 1.0) -> Iterator[Address]:
    """A server that reads one request and sends bytes, some time apart."""
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def respond() -> None:
            with contextlib.suppress(OSError):
                connection, _ = listening.accept()
                with connection, connection.makefile("rb") as request:
                    length = [int(line[15:]) for line in iter(request.readline, b"\r\n") if is_length(line)]
                    request.read(sum(length))  # what is not read would reset the connection
                    for chunk in chunks:
                        connection.sendall(chunk)
                        time.sleep(gap_s)

        thread = threading.Thread(target=respond)
        thread.start()
        yield Address("127.0.0.1", listening.getsockname()[1], answer_s)
        listening.close()
        thread.join()


HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"


@pytest.mark.parametrize(
    ("chunks", "told"),
    [
        ((b"",), "no answer"),
        ((b"nonsense\r\n\r\n",), "no answer"),
        ((HEAD + b"Content-Length: 900\r\n\r\n[1, 2",), "no answer"),
        ((HEAD + b"Content-Length: 5000\r\n\r\n" + b"1" * 5000,), "longer than 1,000 bytes"),
        ((HEAD + b"Content-Length: 4\r\n\r\n{,,}",), "not JSON"),
        ((HEAD + b"Content-Length: 900\r\n\r\n" + b"[" * 900,), "not JSON"),
    ],
)
def test_an_answer_that_is_none_is_one_line(chunks: tuple[bytes, ...], told: str) -> None:
    with raw_server(*chunks) as address, pytest.raises(InputError, match=told) as caught:
        ask(address, "/infer", {}, max_bytes=1000)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "chunks",
    [
        (b"",) * 40,  # silent
        tuple(bytes([byte]) for byte in HEAD[:40]),  # a byte of the head at a time
        (HEAD + b"Content-Length: 99\r\n\r\n", *[b"1"] * 40),
    ],
)
def test_a_slow_server_is_left_after_the_time_of_the_whole_call(chunks: tuple[bytes, ...]) -> None:
    with (
        raw_server(*chunks, gap_s=0.05, answer_s=0.3) as address,
        pytest.raises(InputError, match=r"no answer within 0\.3 s"),
    ):
        ask(address, "/infer", {})


def test_nobody_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(InputError, match=rf"http://127\.0\.0\.1:{port}/alive: no answer"):
        ask(Address("127.0.0.1", port, 1.0), "/alive")


def test_addresses() -> None:
    assert read_address("http://localhost:9000") == Address("localhost", 9000)
    assert read_address("http://10.0.0.5:80/?timeout=2.5") == Address("10.0.0.5", 80, 2.5)
    for wrong in (
        *("http://localhost", "http://:9000", "http://a:b", "https://a:1", "http://a:1/x"),
        *("http://a:1?time=3", "http://a:1?timeout=soon", "http://a:99999"),
    ):
        with pytest.raises(InputError, match="not an address of the form http://HOST:PORT"):
            read_address(wrong)
    for wrong in ("http://a:1?timeout=0", "http://a:1?timeout=nan", "http://a:1?timeout=inf"):
        with pytest.raises(InputError, match="the timeout must be above 0"):
            read_address(wrong)
