"""The bounds of every page and server: connections, threads, and the time in which a request has to arrive.

A client that is silent, or sends one byte at a time, holds a thread and a file descriptor. So the number of
connections is limited. At the limit, the connection that has kept the server waiting longest is closed to
make room for the next one. A client that sends its request without delay is therefore answered, however many
slow clients there are.
"""

import contextlib
import io
import logging
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

MAX_CONNECTIONS = 128
"""Largest number of open connections of a server, each with a thread. A browser opens six."""
REQUEST_S = 30.0
"""Time in which a client has to send its whole request, s."""
SEND_S = 60.0
"""Time in which a client has to take the whole answer, s."""
THREAD_S = 1.0
"""Time to wait for the thread of a closed connection to end, s."""
BACKLOG = 512
"""Connections that the operating system keeps until they are accepted. Others try again after a second."""
PART_BYTES = 2**16
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")

_BUSY = b"HTTP/1.0 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
_log = logging.getLogger(__name__)


def refusal(headers: Mapping[str, str] | Message, host: str) -> str | None:
    """Return why a request is refused that a browser sends for a page of another site; None: it is allowed.

    The Origin header of such a request names the other site. With DNS rebinding, a name of the other site
    resolves to this machine; then the Host header holds that name.

    Args:
        headers: the request's headers.
        host: address at which the server listens.
    """
    asked, origin = headers.get("Host", ""), headers.get("Origin")
    if host in LOOPBACK and asked and _without_port(asked) not in LOOPBACK:
        return f"this server is not at {asked[:100]}"
    if origin is not None and origin.partition("://")[2] != asked:
        return f"{origin[:100]} may not ask this server"
    return None


def _without_port(host: str) -> str:
    return host if host.endswith("]") else host.rpartition(":")[0] or host


class BoundedServer(ThreadingHTTPServer):
    """HTTP server with a thread for each connection, and bounds on both.

    Args:
        max_bytes: size of all bodies of requests that are held at the same time.
    """

    daemon_threads = True
    request_queue_size = BACKLOG

    def __init__(self, address: tuple[str, int], handler: type["BoundedHandler"], max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._lock, self._thread_slots = threading.Lock(), threading.Semaphore(MAX_CONNECTIONS)
        self._held_bytes = dict[socket.socket, int]()
        """All open connections, and the size of the body that has arrived on each."""
        self._waited_for = dict[socket.socket, None]()
        """Connections on whose client the server waits, those that have kept it waiting longest first."""
        super().__init__(address, handler)

    @contextlib.contextmanager
    def working_for(self, connection: socket.socket) -> Iterator[None]:
        """Keep a connection from being closed for another while the block works on its answer.

        Raises:
            ConnectionAbortedError: it has been closed before.
        """
        with self._lock:
            self._check_open(connection)
            self._waited_for.pop(connection, None)
        try:
            yield
        finally:
            with self._lock:
                self._waited_for[connection] = None

    def hold(self, connection: socket.socket, size: int) -> None:
        """Note how much of a body has arrived; close connections if all bodies together are too large.

        Raises:
            ConnectionAbortedError: this connection has been closed.
        """
        with self._lock:
            self._check_open(connection)
            self._held_bytes[connection] = size
            # This connection may be the one that is closed, so it is checked again afterwards
            while sum(self._held_bytes.values()) > self._max_bytes and self._close_longest_waited_for():
                pass
            self._check_open(connection)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer a connection in a thread of its own, or refuse it if all others are being worked for."""
        with self._lock:
            # At the limit, close the slowest client. If no connection can be closed, refuse the new one
            is_full = len(self._held_bytes) >= MAX_CONNECTIONS and not self._close_longest_waited_for()
            if not is_full:
                self._held_bytes[request] = 0
                self._waited_for[request] = None
        # A connection that was closed above still has its thread, which ends at once
        if not is_full and self._thread_slots.acquire(timeout=THREAD_S):
            super().process_request(request, client_address)
            return
        with contextlib.suppress(OSError):
            # Never wait for a refused client: this is the thread that accepts connections
            request.setblocking(False)
            request.send(_BUSY)
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a connection, and make room for another thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._thread_slots.release()

    def shutdown_request(self, request: Any) -> None:
        """Close a connection at the end of its thread."""
        with self._lock:
            self._forget(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log an error of the program. A client that disconnects is not an error."""
        error = sys.exc_info()[1]
        if not isinstance(error, OSError):
            _log.error("while answering %s", client_address, exc_info=error)

    def _close_longest_waited_for(self) -> bool:
        """End the longest wait for a client; its thread finds the connection closed. Return False if none."""
        connection = next(iter(self._waited_for), None)
        if connection is None:
            return False
        self._forget(connection)
        with contextlib.suppress(OSError):
            # Only the connection is closed. Its thread, which may wait in recv, closes the socket itself
            connection.shutdown(socket.SHUT_RDWR)
        return True

    def _forget(self, connection: socket.socket) -> None:
        self._held_bytes.pop(connection, None)
        self._waited_for.pop(connection, None)

    def _check_open(self, connection: socket.socket) -> None:
        if connection not in self._held_bytes:
            raise ConnectionAbortedError


class BoundedHandler(BaseHTTPRequestHandler):
    """Reads one request of a connection within `REQUEST_S`, and sends its answer within `SEND_S`."""

    server: BoundedServer

    def setup(self) -> None:
        """Read from the connection until the time is over."""
        super().setup()
        # Replace the reader of the base class, which has no deadline
        self.rfile.close()
        arriving = _UntilLate(self.connection, time.monotonic() + REQUEST_S)
        self.rfile = io.BufferedReader(arriving, PART_BYTES)

    def log_message(self, format: str, *args: Any) -> None:
        """Log requests at the debug level only."""
        _log.debug(format, *args)

    def read_body(self, length: int) -> bytes:
        """Return the body of a request. Memory is allocated only for the bytes that have arrived."""
        body = bytearray()
        while len(body) < length:
            part = self.rfile.read1(min(length - len(body), PART_BYTES))
            if not part:
                raise ConnectionAbortedError
            body += part
            self.server.hold(self.connection, len(body))
        return bytes(body)

    def send(self, status: int, content: bytes, media_type: str) -> None:
        """Send an answer."""
        self.connection.settimeout(SEND_S)
        self.send_response(status)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)


class _UntilLate(io.RawIOBase):
    """Reader of a connection up to a deadline. A timeout of the socket alone would restart with each byte."""

    def __init__(self, connection: socket.socket, until_s: float) -> None:
        self._connection, self._until_s = connection, until_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left_s = self._until_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the request did not arrive in time")
        # The timeout is what is left of the time of the whole request
        self._connection.settimeout(left_s)
        return self._connection.recv_into(buffer)
