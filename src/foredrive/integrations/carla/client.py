"""Connection to CARLA's server. Only this module imports the package `carla`."""

import contextlib
import importlib
from collections.abc import Iterator
from typing import Any

from foredrive.errors import InputError


def import_carla() -> Any:
    """Import the package `carla`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        wanted = "pip install 'foredrive[carla]' for a server of 0.9.16, 'foredrive[carla-0915]' for 0.9.15"
        raise InputError(f"CARLA's client is missing: {wanted} ({error})") from None


def connect(host: str = "localhost", port: int = 2000, timeout_s: float = 10.0) -> Any:
    """Return a `carla.Client` that is connected to a server of the same version.

    Raises:
        InputError: the client is not installed, no server answers in time, or the versions differ.
    """
    carla = import_carla()
    where = f"{host}:{port}"
    try:
        client = carla.Client(host, port)
        client.set_timeout(timeout_s)
        server = client.get_server_version()
    except RuntimeError as error:
        raise InputError(
            f"no CARLA server answers at {where} within {timeout_s:g} s; start one with "
            f"`./CarlaUE4.sh -RenderOffScreen -carla-rpc-port={port}` ({_one_line(error)})"
        ) from None
    require_same_version(client.get_client_version(), server, where)
    return client


def require_same_version(client: str, server: str, where: str) -> None:
    """Refuse a server of another version, whose protocol may cause unclear errors later.

    Raises:
        InputError: the versions differ. The error names both.
    """
    if server != client:
        raise InputError(
            f"the CARLA server at {where} is version {server}, the client {client}: install the same version"
        )


@contextlib.contextmanager
def answering(what: str) -> Iterator[None]:
    """Turn the client's errors (no server, or a slow one) into one line that says what was tried.

    Raises:
        InputError: the client raised RuntimeError.
    """
    try:
        yield
    except RuntimeError as error:
        raise InputError(f"CARLA, {what}: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
