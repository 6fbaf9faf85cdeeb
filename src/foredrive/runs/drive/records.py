"""Files of drives (drives/NAME.json in a folder), and the summary of a suite."""

import dataclasses
import json
import statistics
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from foredrive.driving.bench2drive import Bench2DriveDrive, bench2drive_figures, succeeds
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.aggregation import TestedRun, aggregate
from foredrive.driving.replay.threats import Threat
from foredrive.driving.scores import score_suite
from foredrive.driving.time_to_collision import NEAR_COLLISION_S
from foredrive.engine.folder import SUITE
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_json
from foredrive.errors import InputError
from foredrive.towns.scenarios.scenario import ScenarioKind

_RECORD = TypeAdapter(DriveRecord)
Figures = dict[str, float | int | str | None]


def write_drive(path: Path, record: DriveRecord) -> None:
    """Write the record of a drive as JSON."""
    content = _RECORD.dump_python(record, mode="json")
    for name in ("threat", "trusted_share", "efficiency_pct", "smoothness_pct"):
        if content[name] is None:
            del content[name]
    write_json(path, content)


def read_drive(path: Path) -> DriveRecord:
    """Read the record of a drive.

    Raises:
        InputError: the file holds no record of a drive.
    """
    try:
        return _RECORD.validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        why = ": ".join([".".join(map(str, first["loc"])), first["msg"]])
    except OSError as error:
        why = str(error)
    raise InputError(f"{path}: not the record of a drive ({why}); delete it to repeat the drive")


def read_suite(folder: Path) -> dict[str, object]:
    """Read the description of a suite.

    Raises:
        InputError: the folder has no suite file, or the file describes no suite.
    """
    try:
        suite: dict[str, object] = json.loads((folder / SUITE).read_text())
        if not isinstance(suite["agent"], str) or not isinstance(suite["routes"], str):
            raise TypeError("agent and routes have to be texts")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{folder / SUITE}: not the description of a suite ({error})") from error
    return suite


def suite_title(folder: Path) -> str:
    """Return the title of a suite: the agent as it was given, and the routes.

    The paths of a suite are absolute. Those in the current folder are shown relative to it, and of others the
    last part.

    Raises:
        InputError: as `read_suite`.
    """
    suite = read_suite(folder)
    agent = str(suite["agent"]).replace(f"{Path.cwd()}/", "")
    name = Path(agent).name if Path(agent).is_absolute() else agent
    return f"{name} on {Path(str(suite['routes'])).stem}"


def summarise(drives: Sequence[DriveRecord]) -> Figures:
    """Compute the metrics of a suite as a flat dict.

    A drive that failed because of the agent is scored by the distance that it drove.
    """
    suite = score_suite([drive.score for drive in drives])
    out: Figures = {
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
    out |= {f"infractions_per_km.{kind}": rate for kind, rate in suite.infractions_per_km.items()}
    begun = Counter(event.what for drive in drives for event in drive.scenario_events)
    out |= {f"scenarios.{kind}": begun[kind] for kind in ScenarioKind}
    comfortable = [drive.comfort.comfortable_share for drive in drives if drive.comfort]
    near = [
        seconds is not None and seconds < NEAR_COLLISION_S for drive in drives for seconds in drive.nearest_s
    ]
    plan_ms = [1000 * seconds for drive in drives for seconds in drive.act_s]
    out["comfortable_share"] = statistics.fmean(comfortable) if comfortable else None
    out["near_collision_share"] = statistics.fmean(near) if near else None
    trusted = [drive.trusted_share for drive in drives if drive.trusted_share is not None]
    if trusted:
        out["trusted_share"] = statistics.fmean(trusted)
    figures = bench2drive_figures(
        [
            Bench2DriveDrive(
                succeeds(drive.score),
                drive.efficiency_pct,
                drive.smoothness_pct,
                frozenset(event.what for event in drive.scenario_events),
            )
            for drive in drives
        ]
    )
    out |= {f"bench2drive.{name}": value for name, value in figures.items()}
    out["plan_ms"] = statistics.median(plan_ms) if plan_ms else None
    out["driven_s"] = sum(drive.score.duration_s for drive in drives)
    out["wall_s"] = sum(drive.wall_s for drive in drives)
    return out | collect_provenance() | _threat_figures(drives)


def tested_runs(drives: Sequence[DriveRecord]) -> list[TestedRun]:
    """Return the drives against a threat as runs of safety tests; the route of a drive is its scenario."""
    return [
        TestedRun(
            drive.score.route,
            _place_of(drive.score.route, drive.threat.kind),
            drive.threat,
            min((seconds for seconds in drive.nearest_s if seconds is not None), default=None),
            drive.comfort.comfortable_share if drive.comfort else None,
            drive.trusted_share,
        )
        for drive in drives
        if drive.threat is not None
    ]


def _place_of(scenario: str, kind: Threat) -> str:
    """Return where and when a scenario begins, by its name: KIND-PLACE, or PLACE_KIND with a variation."""
    return scenario.removeprefix(f"{kind}-").partition(f"_{kind}")[0]


def _threat_figures(drives: Sequence[DriveRecord]) -> Figures:
    """Return the figures of each kind of threat met, and their mean over the kinds."""
    runs = tested_runs(drives)
    if not runs:
        return {}
    _, kinds, overall = aggregate(runs)
    out: Figures = {}
    for name, of in [*((str(kind), of) for kind, of in kinds.items()), ("all", overall)]:
        for key in ("score", "collision_rate"):
            interval = getattr(of, key)
            for part, end in (("mean", ""), ("low", ".low"), ("high", ".high")):
                out[f"threats.{name}.{key}{end}"] = None if interval is None else getattr(interval, part)
        for field in dataclasses.fields(of):
            if field.name not in ("score", "collision_rate"):
                out[f"threats.{name}.{field.name}"] = getattr(of, field.name)
    return out
