"""What is kept of drives: DRIVES/NAME.json in a folder, and the figures of all together."""

import dataclasses
import json
import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from foredrive.errors import InputError
from foredrive.evaluation import collect_provenance
from foredrive.simulation.drive import Drive
from foredrive.simulation.scenarios.kinds import ScenarioKind
from foredrive.simulation.scores import Ending, Infraction, InfractionKind, RouteScore, score_suite
from foredrive.simulation.time_to_collision import LEAST_S

SUITE, DRIVES, SUMMARY = "suite.json", "drives", "summary.json"
TRACK_EVERY = 5
"""Of the states of a drive one in this many is kept: four a second."""


def kept_of(
    drive: Drive, route_xyz: Float64[np.ndarray, "N 3"], length_m: float, town: str | None, wall_s: float
) -> dict[str, Any]:
    """What is kept of a drive, for JSON.

    Args:
        town: whose lanes are drawn below it; None where there is no map.
    """
    states = drive.states[::TRACK_EVERY]
    return {
        "town": town,
        "length_m": length_m,
        "score": dataclasses.asdict(drive.score),
        "driving_score_1_0": drive.score.driving_score_1_0,
        "driving_score_2_1": drive.score.driving_score_2_1,
        "error": drive.error,
        "events": [dataclasses.asdict(event) for event in drive.events],
        "comfort": None if drive.comfort is None else dataclasses.asdict(drive.comfort),
        "nearest_s": drive.nearest_s,
        "act_s": drive.act_s,
        "route_xy": route_xyz[:, :2].round(2).tolist(),
        "track": {
            "t_s": [round(0.05 * TRACK_EVERY * k, 2) for k in range(len(states))],
            "xy": [(round(s.x_m, 2), round(s.y_m, 2)) for s in states],
            "yaw_rad": [round(s.yaw_rad, 4) for s in states],
            "speed_mps": [round(s.speed_mps, 3) for s in states],
        },
        "wall_s": wall_s,
    }


def read_drive(path: Path) -> dict[str, Any]:
    """What was kept of a drive.

    Raises:
        InputError: the file is no drive.
    """
    try:
        drive: dict[str, Any] = json.loads(path.read_text())
        score_of(drive)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not what is kept of a drive ({error}); delete it to drive again") from None
    return drive


def score_of(drive: dict[str, Any]) -> RouteScore:
    """The score of what was kept of a drive."""
    fields = drive["score"]
    infractions = tuple(
        Infraction(**{**each, "kind": InfractionKind(each["kind"]), "xy_world": tuple(each["xy_world"])})
        for each in fields["infractions"]
    )
    return RouteScore(**{**fields, "ending": Ending(fields["ending"]), "infractions": infractions})


def summarise(drives: Sequence[dict[str, Any]]) -> dict[str, float | int | str | None]:
    """The figures of a suite, flat; a driver who failed by his own fault is scored by what he drove."""
    suite = score_suite([score_of(drive) for drive in drives])
    out: dict[str, float | int | str | None] = {
        "routes": suite.routes,
        "repetitions": suite.repetitions,
        "drives": len(drives),
        "failed": suite.failed,
    }
    for name in ("driving_score_1_0", "driving_score_2_1", "completion"):
        value = getattr(suite, name)
        out |= {name: value.mean, f"{name}.spread": value.spread}
    out |= {f"endings.{ending}": count for ending, count in suite.endings.items()}
    out |= {f"infractions.{kind}": count for kind, count in suite.infractions.items()}
    out |= {f"infractions_per_km.{kind}": each for kind, each in suite.infractions_per_km.items()}
    begun = Counter(e["what"] for drive in drives for e in drive["events"] if e["kind"] == "scenario")
    out |= {f"scenarios.{kind}": begun[kind] for kind in ScenarioKind}
    comfortable = [drive["comfort"]["comfortable_share"] for drive in drives if drive["comfort"]]
    near = [seconds is not None and seconds < LEAST_S for drive in drives for seconds in drive["nearest_s"]]
    plan_ms = [1000 * seconds for drive in drives for seconds in drive["act_s"]]
    out["comfortable_share"] = statistics.fmean(comfortable) if comfortable else None
    out["near_collision_share"] = statistics.fmean(near) if near else None
    out["plan_ms"] = statistics.median(plan_ms) if plan_ms else None
    out["driven_s"] = sum(drive["score"]["duration_s"] for drive in drives)
    out["wall_s"] = sum(drive["wall_s"] for drive in drives)
    return out | collect_provenance()
