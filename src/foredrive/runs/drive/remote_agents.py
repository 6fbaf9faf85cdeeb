"""Agents in other processes: their clients, and the check that they are alive."""

import importlib.util
from collections.abc import Callable
from typing import TYPE_CHECKING

from foredrive.errors import InputError
from foredrive.json_http import read_address

if TYPE_CHECKING:
    from foredrive.scene import Agent

Clock = Callable[[], float]
"""Returns the time of the drive, s."""


def require_alpasim() -> None:
    """Check that AlpaSim's contract is installed.

    Raises:
        InputError: it is not.
    """
    if importlib.util.find_spec("carla_driver_interface") is None:
        raise InputError("AlpaSim's driver contract is missing: pip install 'foredrive[alpasim]'")


def build_http(agent: str, clock: Clock, *, cameras: bool, lidar: bool) -> "Agent":
    """Build the client of a planner behind neuro-ncap's protocol."""
    from foredrive.integrations.remote.planner_client import HttpPlanner

    return HttpPlanner(read_address(agent, "http"), clock, cameras=cameras, lidar=lidar)


def build_grpc(agent: str, clock: Clock) -> "Agent":
    """Build the client of a driver behind AlpaSim's contract."""
    require_alpasim()
    from foredrive.integrations.remote.alpasim_client import GrpcDriver

    return GrpcDriver(read_address(agent, "grpc"), clock)


def check_http(agent: str) -> None:
    """Wait for a planner. Raise `InputError` if it does not answer."""
    from foredrive.integrations.remote.planner_client import check_planner

    check_planner(read_address(agent, "http"))


def check_grpc(agent: str) -> None:
    """Wait for a driver. Raise `InputError` if it does not answer."""
    require_alpasim()
    from foredrive.integrations.remote.alpasim_client import check_driver
    from foredrive.integrations.remote.planner_client import ALIVE_S

    check_driver(read_address(agent, "grpc"), ALIVE_S)
