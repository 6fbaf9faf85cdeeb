"""Servers of runs for other programs: a reconstruction as a renderer, an agent as a planner."""

import contextlib
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from foredrive.data.boxes import read_track_ids
from foredrive.data.logs import Log
from foredrive.engine.folder import CONFIG, LOG
from foredrive.errors import InputError
from foredrive.integrations.remote.planner_server import PlannerNeeds, PlannerService
from foredrive.integrations.remote.render_server import RenderService
from foredrive.json_server import Answer
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import make_agent
from foredrive.runs.drive.remote_agents import require_alpasim
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction, open_run_log
from foredrive.runs.reconstruction.trust import trust_of

Answers = Mapping[tuple[str, str], Answer]


def is_reconstruction(folder: Path) -> bool:
    """Return whether a folder holds a reconstruction, finished or not."""
    return (folder / CONFIG).is_file() and (folder / LOG).is_file()


def renderer_of(folder: Path) -> Answers:
    """Return the answers of a reconstruction as neuro-ncap's renderer server.

    Names of actors and the time of the start are those of the log if it is still there. Without it, actors
    have their numbers as names, and the log starts at 0.

    Raises:
        InputError: the folder holds no finished reconstruction.
    """
    opened, names, start_us = open_reconstruction(folder), dict[int, str](), 0
    # The log may have been moved or deleted since
    with contextlib.suppress(InputError):
        log = Log(open_run_log(folder)[1])
        names, start_us = {number: token for token, number in read_track_ids(log).items()}, int(log.t_us[0])
    trust = functools.partial(trust_of, opened)
    return RenderService(opened.scene, opened.vehicle, names, start_us, trust).answers()


def planner_of(agent: str) -> Answers:
    """Return the answers of an agent of `foredrive drive` as neuro-ncap's model server.

    Raises:
        InputError: there is no such agent, or it reads the state of a town.
    """
    return PlannerService(lambda clock: make_agent(agent, clock), _needs_of(agent)).answers()


def alpasim_server_of(agent: str, host: str, port: int) -> tuple[Any, int]:
    """Return an agent of `foredrive drive` as a server of AlpaSim's driver contract, and its port.

    The caller starts and stops the server.

    Raises:
        InputError: there is no such agent, the contract is not installed, or the address cannot be served.
    """
    require_alpasim()
    from foredrive.integrations.remote.alpasim_server import AlpasimDriver, serve_alpasim

    make_agent(agent, lambda: 0.0)  # Reports errors at the start, not at the first drive
    driver = AlpasimDriver(Path(agent).name, lambda clock: make_agent(agent, clock), _needs_of(agent))
    return serve_alpasim(driver, host, port)


def _needs_of(agent: str) -> PlannerNeeds:
    inputs = inputs_of(agent)
    cameras = None if inputs.camera_names is None else tuple(name.lower() for name in inputs.camera_names)
    return PlannerNeeds(inputs.past_frames, cameras if inputs.cameras else ())
