"""Drives of the simplest agents over the routes of a suite, for comparisons."""

from pathlib import Path
from typing import Any

from foredrive.driving.replay.threats import Threat
from foredrive.engine.folder import SUITE
from foredrive.errors import InputError
from foredrive.runs.drive.in_reconstruction import ReconstructedRoutes
from foredrive.runs.drive.in_towns import TownRoutes
from foredrive.runs.drive.records import read_suite
from foredrive.runs.drive.suite import DriveSource, DriveSuite

_TOWN = {"routes", "repetitions", "seed", "conditions", "vehicles", "people", "only", "scenarios"}
_RECONSTRUCTED = {"run", "starts_s", "threats", "edits", "stay_trusted"}


def same_drives(folder: Path, agent: str) -> DriveSuite:
    """Return a suite of the same drives as in a folder, with another agent that sees nothing.

    Raises:
        InputError: the folder holds no suite of towns or of a reconstruction.
    """
    noted: dict[str, Any] = read_suite(folder)
    source: DriveSource
    if _RECONSTRUCTED - {"stay_trusted"} <= noted.keys():
        fields = {key: noted[key] for key in _RECONSTRUCTED & noted.keys()}
        fields |= {"starts_s": tuple(noted["starts_s"]), "threats": tuple(map(Threat, noted["threats"]))}
        source = ReconstructedRoutes(**fields)
    elif _TOWN - {"only"} <= noted.keys() and "server" not in noted:
        fields = {key: noted[key] for key in _TOWN & noted.keys()}
        source = TownRoutes(**fields | {"only": tuple(noted.get("only", ()))})
    else:
        raise InputError(f"{folder / SUITE}: baselines drive in towns and reconstructed logs alone")
    return DriveSuite(agent, source, sensors=False, period_s=noted["period_s"], latency_s=noted["latency_s"])
