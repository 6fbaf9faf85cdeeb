"""A viser page in the browser: its port, and an empty scene."""

import asyncio
import contextlib
import errno
import io
import logging
import socket
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server
from websockets import Request, Response, State
from websockets.asyncio.server import ServerConnection

from foredrive.errors import InputError
from foredrive.json_http import MAX_CONNECTIONS, REQUEST_S, refusal

PORTS, PORTS_TRIED = 65536, 100
AMBIENT_LIGHT = 0.7
_log = logging.getLogger(__name__)
# A failed handshake is an error of the client and not worth a line
_log.addFilter(lambda record: record.msg != "opening handshake failed")
START_EYE_M, START_TARGET_M = (-20.0, 8.0, 15.0), (6.0, 0.0, 0.0)


def free_port(host: str, port: int) -> int:
    """Return the first free port from `port` on; any free port if `port` is 0.

    Raises:
        InputError: the host or the port does not exist, or this user may not serve there.
    """
    if not 0 <= port < PORTS:
        raise InputError(f"no port {port}: there are 0 to {PORTS - 1}")
    candidates = range(port, min(port + PORTS_TRIED, PORTS))
    for candidate in candidates:
        try:
            with socket.create_server((host, candidate)) as server:
                return int(server.getsockname()[1])
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise InputError(f"cannot serve a page at {host}:{candidate}: {error}") from error
    raise InputError(f"cannot serve a page at {host}: ports {port} to {candidates[-1]} are taken")


class _BoundedConnection(ServerConnection):
    """A connection that gives way to new ones if its client does not finish its request."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        # Connections whose handshake is not complete, the oldest first; abort one for the new connection
        waited_for = [one for one in self.server.handlers if one.state is State.CONNECTING]
        if len(waited_for) > MAX_CONNECTIONS:
            waited_for[0].transport.abort()


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    """Make servers that viser starts in the block refuse requests of other sites' pages, and bound them.

    viser has no option for either. Browsers let any page open a WebSocket to this machine, through which the
    page could see the log and move the controls. Of the bounds, `websockets` itself offers only the one on
    the time of a request.
    """
    # viser calls this function by its module, so that it can be replaced while viser starts
    serve = websockets.asyncio.server.serve

    def checking(
        handler: Any, host: str, port: int, *, process_request: Callable[..., Response | None], **options: Any
    ) -> Any:
        def checked(connection: ServerConnection, request: Request) -> Response | None:
            why = refusal(request.headers, host)
            if why is not None:
                return connection.respond(403, f"{why}\n")
            viewers = sum(one.state is State.OPEN for one in connection.server.handlers)
            if viewers >= MAX_CONNECTIONS:
                return connection.respond(503, "too many viewers\n")
            return process_request(connection, request)

        bounds: dict[str, Any] = {
            "create_connection": _BoundedConnection,
            "logger": _log,
            "open_timeout": REQUEST_S,
        }
        return serve(handler, host, port, process_request=checked, **options, **bounds)

    websockets.asyncio.server.serve = checking  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]


def _open_server(label: str, host: str, port: int) -> viser.ViserServer:
    """Serve an empty dark page in threads of the server, seen from behind and above the ego vehicle."""
    port = free_port(host, port)  # With a host that does not exist, viser would wait
    with contextlib.redirect_stdout(io.StringIO()), _bounded():  # viser prints a greeting
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
    server.scene.configure_environment_map(hdri=None)  # Light without a downloaded environment map
    server.scene.add_light_ambient("/light", intensity=AMBIENT_LIGHT)
    server.initial_camera.position = START_EYE_M
    server.initial_camera.look_at = START_TARGET_M
    return server


class Page:
    """A served page.

    Args:
        label: title of the page.
        host, port: address of the page; if the port is taken, the next free one.

    Raises:
        InputError: as `free_port`.
    """

    def __init__(self, label: str, host: str, port: int) -> None:
        self.server = _open_server(label, host, port)

    @property
    def url(self) -> str:
        """Return the page's address."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        with contextlib.suppress(RuntimeError):  # viser's thread may end before it has handled all calls
            self.server.stop()
