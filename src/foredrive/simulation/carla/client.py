"""The way to CARLA's server: the one place that imports the package `carla`."""

import contextlib
import importlib
from collections.abc import Iterator
from typing import Any

from foredrive.errors import InputError


def import_carla() -> Any:
    """The package `carla`.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module("carla")
    except ImportError as error:
        raise InputError(f"CARLA's client is missing: pip install 'foredrive[carla]' ({error})") from None


def connect(host: str = "localhost", port: int = 2000, timeout_s: float = 10.0) -> Any:
    """A `carla.Client` whose server answers and is of its version.

    Raises:
        InputError: there is no client, no server answers in time, or their versions differ.
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
    """Refuse a server that speaks another version's protocol: it would fail later, and darkly.

    Raises:
        InputError: naming both.
    """
    if server != client:
        raise InputError(
            f"the CARLA server at {where} is version {server}, the client {client}: they have to be the same"
        )


@contextlib.contextmanager
def answering(what: str) -> Iterator[None]:
    """Turn the client's errors (the server is gone, or too slow) into one line that says what was tried.

    Raises:
        InputError: the client raised RuntimeError.
    """
    try:
        yield
    except RuntimeError as error:
        raise InputError(f"CARLA, {what}: {_one_line(error)}") from error


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
