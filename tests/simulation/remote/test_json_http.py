"""JSON over real loopback sockets: what is answered, and every way in which a server does not answer."""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from http.client import HTTPConnection

import pytest

from foredrive.errors import InputError
from foredrive.simulation.remote.json_http import Address, JsonServer, Raw, ask, read_address


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


def test_values_errors_and_other_content_are_answered() -> None:
    def fails(_: object) -> object:
        raise RuntimeError("secret")

    def refuses(body: object) -> object:
        raise InputError(f"not {body}")

    answers = {
        ("POST", "/twice"): lambda body: [body, body],
        ("GET", "/alive"): lambda _: True,
        ("GET", "/text"): lambda _: Raw(b'"as it is"', "text/plain"),
        ("POST", "/fails"): fails,
        ("POST", "/refuses"): refuses,
    }
    with JsonServer(answers, max_bytes=100).in_background() as address:
        assert ask(address, "/twice", {"a": [1.5, None]}) == [{"a": [1.5, None]}] * 2
        assert ask(address, "/alive") is True
        assert ask(address, "/text") == "as it is"
        for path, body, told in (
            ("/refuses", 3, "error 422.*not 3"),
            ("/fails", 3, "error 500.*internal error"),
            ("/nowhere", 3, "error 404.*no POST /nowhere; there are: POST /twice"),
            ("/twice", "x" * 200, "422.*a request may have 100 bytes, not 202"),
        ):
            with pytest.raises(InputError, match=told) as caught:
                ask(address, path, body)
            assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("head", "told"),
    [
        (b"Content-Type: application/json\r\n", "needs a Content-Length"),
        (b"Content-Type: text/plain\r\nContent-Length: 2\r\n", "application/json"),
        (b"Content-Type: application/json\r\nContent-Length: 2\r\n", "not JSON"),
        (b"Content-Type: application/json\r\nContent-Length: -1\r\n", "needs a Content-Length"),
    ],
)
def test_a_server_refuses_requests_of_other_forms(head: bytes, told: str) -> None:
    with (
        JsonServer({("POST", "/x"): lambda body: body}).in_background() as address,
        socket.create_connection((address.host, address.port)) as connection,
    ):
        connection.sendall(b"POST /x HTTP/1.1\r\n" + head + b"\r\n{,")
        answer = connection.makefile("rb").read()
    assert b" 422 " in answer.splitlines()[0]
    assert told in json.loads(answer.partition(b"\r\n\r\n")[2])["detail"]


HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"


@pytest.mark.parametrize(
    ("chunks", "told"),
    [
        ((b"",), "no answer"),
        ((b"nonsense\r\n\r\n",), "no answer"),
        ((HEAD + b"Content-Length: 900\r\n\r\n[1, 2",), "not JSON"),
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


def test_a_taken_port_is_one_line() -> None:
    server = JsonServer({})
    with pytest.raises(InputError, match="cannot be served"):
        JsonServer({}, port=server.address.port)
    server.close()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Host": "localhost:80"}, 200),
        ({"Host": "attacker.example:80"}, 403),
        ({"Origin": "http://attacker.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
def test_pages_of_other_sites_are_refused(headers: dict[str, str], status: int) -> None:
    with JsonServer({("GET", "/alive"): lambda _: True}).in_background() as address:
        connection = HTTPConnection(address.host, address.port, timeout=5)
        connection.request("GET", "/alive", headers=headers)
        answer = connection.getresponse()
        assert answer.status == status
        answer.read()
        connection.close()
