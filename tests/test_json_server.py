"""JSON over real loopback sockets: what is answered, and what many bad clients cannot do."""

import contextlib
import gzip
import json
import logging
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection

import pytest

from foredrive import json_server
from foredrive.errors import InputError
from foredrive.json_http import Address, ask
from foredrive.json_server import JsonServer, Raw

BAD_CLIENTS = 200
PACKED = gzip.compress(b" " * 5000 + b"1", mtime=0)  # without the time: it names a test
POST = b"POST /twice HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"


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
    ("head", "body", "told"),
    [
        (b"Content-Type: application/json\r\n", b"", "needs a Content-Length"),
        (b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n", b"0\r\n\r\n", "Content-Length"),
        (b"Content-Type: text/plain\r\nContent-Length: 2\r\n", b"{,", "application/json"),
        (b"Content-Type: application/json\r\nContent-Length: 2\r\n", b"{,", "not JSON"),
        (
            b"Content-Type: application/json\r\nContent-Encoding: gzip\r\nContent-Length: %d\r\n"
            % len(PACKED),
            PACKED,
            "not JSON",
        ),
    ],
    ids=["no length", "chunked", "text", "no JSON", "packed"],
)
def test_a_server_refuses_requests_of_other_forms(head: bytes, body: bytes, told: str) -> None:
    with (
        JsonServer({("POST", "/x"): lambda body: body}).in_background() as address,
        socket.create_connection((address.host, address.port)) as connection,
    ):
        connection.sendall(b"POST /x HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\n" + body)
        answer = connection.makefile("rb").read()
    assert b" 422 " in answer.splitlines()[0]
    assert told in json.loads(answer.partition(b"\r\n\r\n")[2])["detail"]


def test_a_taken_port_is_one_line() -> None:
    with (
        JsonServer({}).in_background() as address,
        pytest.raises(InputError, match="cannot be served"),
    ):
        JsonServer({}, port=address.port)


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


@contextlib.contextmanager
def served(max_bytes: int = 10_000) -> Iterator[Address]:
    answers = {("GET", "/alive"): lambda _: True, ("POST", "/twice"): lambda body: [body, body]}
    with JsonServer(answers, max_bytes=max_bytes).in_background() as address:
        yield address


@contextlib.contextmanager
def bad_clients(address: Address, sent: bytes) -> Iterator[list[socket.socket]]:
    """Connections that have sent some bytes and wait."""
    with contextlib.ExitStack() as stack:
        clients = []
        for _ in range(BAD_CLIENTS):
            client = socket.create_connection((address.host, address.port), timeout=20)
            clients.append(stack.enter_context(client))
            with contextlib.suppress(OSError):  # closed for the next ones
                client.sendall(sent)
        yield clients


def is_closed(client: socket.socket) -> bool:
    with contextlib.suppress(ConnectionResetError):
        return client.recv(1) == b""
    return True


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"P",
        b"GET /alive HTTP/1.1\r\nHost: ",
        POST + b"Content-Length: 9000\r\n\r\n[",
        POST + b"Content-Length: 9000\r\n\r\n[" + b" " * 8998,
    ],
    ids=["silent", "a byte", "half a header", "a byte of a body", "almost a body"],
)
def test_a_good_client_is_answered_beside_two_hundred_bad_ones(sent: bytes) -> None:
    before = threading.active_count()
    with served() as address, bad_clients(address, sent) as clients:
        began_s = time.monotonic()
        assert ask(address, "/alive") is True
        assert ask(address, "/twice", "x" * 5000) == ["x" * 5000] * 2
        assert time.monotonic() - began_s < 1.0
        while threading.active_count() - before > json_server.MAX_CONNECTIONS + 1:  # the server's own
            assert time.monotonic() - began_s < 5.0
            time.sleep(0.01)
        assert is_closed(clients[0])  # the first ones were closed for the others


@pytest.mark.parametrize("head", [POST, POST + b"Content-Length: 9000\r\n\r\n"], ids=["head", "body"])
def test_a_request_that_comes_byte_by_byte_ends_in_time(head: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others are answered beside it."""
    monkeypatch.setattr(json_server, "REQUEST_S", 0.5)
    with served() as address, socket.create_connection((address.host, address.port), timeout=20) as client:
        began_s = time.monotonic()
        client.sendall(head)
        with contextlib.suppress(OSError):
            while time.monotonic() - began_s < 20:
                client.sendall(b"1")
                assert ask(address, "/twice", 1) == [1, 1]
                time.sleep(0.02)
        assert 0.4 < time.monotonic() - began_s < 10


def test_an_answer_that_nobody_takes_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_server, "SEND_S", 0.5)
    large = {("GET", "/large"): lambda _: "x" * 2**25}  # more than the sockets of both sides keep
    with JsonServer(large).in_background() as address:
        assert ask(address, "/large") == "x" * 2**25
        with socket.create_connection((address.host, address.port), timeout=20) as client:
            client.sendall(b"GET /large HTTP/1.1\r\nHost: localhost\r\n\r\n")
            time.sleep(1.0)
            taken = 0
            with contextlib.suppress(ConnectionResetError):
                while part := client.recv(2**20):
                    taken += len(part)
        assert taken < 2**25


def test_clients_that_work_is_done_for_are_not_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_server, "MAX_CONNECTIONS", 2)
    begun, go_on = threading.Semaphore(0), threading.Event()

    def slow(_: object) -> bool:
        begun.release()
        return go_on.wait(20)

    server, answers = JsonServer({("GET", "/slow"): slow}, one_at_a_time=False), list[object]()
    with server.in_background() as address:
        threads = [threading.Thread(target=lambda: answers.append(ask(address, "/slow"))) for _ in range(2)]
        for thread in threads:
            thread.start()
            assert begun.acquire(timeout=20)
        with pytest.raises(InputError, match="error 503"):
            ask(address, "/slow")
        go_on.set()
        for thread in threads:
            thread.join()
    assert answers == [True, True]


@pytest.mark.parametrize("one_at_a_time", [True, False])
def test_functions_run_one_after_the_other_if_they_have_to(one_at_a_time: bool) -> None:
    running, most = 0, 0

    def counts(_: object) -> bool:
        nonlocal running, most
        running += 1
        most = max(most, running)
        time.sleep(0.2)
        running -= 1
        return True

    server = JsonServer({("GET", "/count"): counts}, one_at_a_time=one_at_a_time)
    with server.in_background() as address, ThreadPoolExecutor(3) as clients:
        assert list(clients.map(lambda _: ask(address, "/count"), range(3))) == [True] * 3
    assert (most == 1) is one_at_a_time


def test_bodies_together_are_bounded() -> None:
    """Of bodies of 9 kB that do not end, those that came first are given up for the next."""
    with served(max_bytes=9000) as address, contextlib.ExitStack() as stack:
        clients = []
        for _ in range(json_server.BODIES + 2):
            client = stack.enter_context(socket.create_connection((address.host, address.port), timeout=20))
            client.sendall(POST + b"Content-Length: 9000\r\n\r\n" + b" " * 8999)
            clients.append(client)
            time.sleep(0.05)
        assert all(map(is_closed, clients[:2]))
        clients[-1].sendall(b"7")
        assert clients[-1].makefile("rb").read().endswith(b"\r\n\r\n[7, 7]")


@pytest.mark.parametrize(
    "sent",
    [
        b"GET //[ HTTP/1.1\r\n\r\n",
        b"GET /alive?%zz=%ff&&&= HTTP/1.1\r\n\r\n",
        b"GET /alive?" + b"a=1&" * 500 + b" HTTP/1.1\r\n\r\n",
        POST + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n",
        POST + b"Content-Length: \xb2\r\n\r\n",
        POST + b"Content-Length: 9000\r\n\r\n" + b"[" * 9000,
        POST + b"Content-Length: 5\r\n\r\n[1]",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200) + b"\r\n\r\n",
        b"GET " + b"/" * 70_000 + b" HTTP/1.1\r\n\r\n",
        b"GET /alive HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n",
        b"GET /alive\r\n\r\n",
    ],
)
def test_mad_requests_and_clients_that_go_are_not_worth_a_line(
    sent: bytes, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    with caplog.at_level(logging.INFO), served() as address:
        for linger in (False, True):  # one that hears the answer, and one that breaks off
            with socket.create_connection((address.host, address.port), timeout=20) as client:
                client.sendall(sent)
                if linger:
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                else:
                    client.shutdown(socket.SHUT_WR)
                    with contextlib.suppress(ConnectionResetError):
                        client.makefile("rb").read()
        assert ask(address, "/alive") is True
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_values_of_a_request_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_server, "MAX_VALUES", 100)
    with served() as address:
        assert ask(address, "/twice", [[]] * 50) == [[[]] * 50] * 2
        with pytest.raises(InputError, match=r"422.*may have 100 values"):
            ask(address, "/twice", [[]] * 51)
