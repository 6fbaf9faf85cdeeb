"""The report on a suite of closed-loop drives: scores, and path, speed and video of each drive."""

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from foredrive.data.log_paths import LogPath
from foredrive.driving.drive_record import DriveRecord
from foredrive.driving.ncap.outcome import Outcome, SafetyResult
from foredrive.driving.scores import Ending, Infraction, InfractionKind
from foredrive.driving.time_to_collision import NEAR_COLLISION_S
from foredrive.engine.folder import DRIVES, SUMMARY
from foredrive.engine.summary import Summary, read_summary
from foredrive.errors import InputError
from foredrive.files import latest
from foredrive.runs.drive.records import read_drive, read_suite, suite_title
from foredrive.towns.scenarios.scenario import ScenarioKind
from foredrive.view.drive_plots import LETTERS, draw_drive_path, draw_timeline
from foredrive.view.drive_video import Lanes, write_drive_video
from foredrive.view.html import MetricTile, Provenance, inline_svg, write_page
from foredrive.view.summary_tables import full_table
from foredrive.view.table import (
    MISSING,
    Cell,
    Column,
    Row,
    Section,
    Table,
    Value,
    number,
    simple_table,
    words,
)

REPORT, VIDEOS = "report.html", "videos"
LEADERBOARDS = {
    "driving_score_1_0": "Driving score, leaderboard 1.0",
    "driving_score_2_1": "Driving score, leaderboard 2.1",
}
BENCH2DRIVE = {"success": "Success", "efficiency": "Efficiency", "smoothness": "Smoothness"}
SCORES = {**LEADERBOARDS, "completion": "Route completion, %"}


@dataclass(frozen=True)
class DriveEvent:
    """An infraction, a scenario or a threat in a drive."""

    t_s: float | None
    """Time of the drive, s; None: it concerns the whole drive."""
    kind: str
    text: str


@dataclass(frozen=True)
class ShownDrive:
    """The values of one drive that the page template shows."""

    name: str
    score: str
    ending: str
    error: str | None
    path_plot: Markup
    timeline: Markup
    events: list[DriveEvent]
    video: str
    """URL of the video, relative to the page."""


def score_table(summary: Summary) -> Table:
    """Return a table of the main metrics."""
    has_repetitions = _repeated(summary)
    scores = []
    for key, name in SCORES.items():
        spread = f" ± {number(summary[f'{key}.spread'], 1)}" if has_repetitions else ""
        scores.append(Row([name, f"{number(summary[key], 1)}{spread}"]))
    wrong = [
        Row([words(kind), f"{number(count)}  ({number(per_km, 2)} / km)"])
        for kind, count, per_km in _infractions(summary)
    ]
    wrong += [
        Row([f"ended: {words(ending)}", summary[f"endings.{ending}"]])
        for ending in Ending
        if ending is not Ending.COMPLETED and summary[f"endings.{ending}"]
    ]
    # Suites from before these metrics have none
    scores += [
        Row([f"{name} (Bench2Drive), %", number(summary[f"bench2drive.{key}_pct"], 1)])
        for key, name in BENCH2DRIVE.items()
        if f"bench2drive.{key}_pct" in summary
    ]
    rest = [
        Row(["Failed drives", summary["failed"]]),
        Row(["Planning time, median, ms", number(summary["plan_ms"], 0)]),
    ]
    if "trusted_share" in summary:
        rest.append(Row(["Key frames with trusted images, %", _percent(summary["trusted_share"])]))
    title = f"{_number_of(summary['routes'], 'route')}, {_number_of(summary['repetitions'], 'repetition')}"
    return Table([Column(align="left"), Column()], [Section(scores), Section(wrong), Section(rest)], title)


def write_drive_report(out: Path, shown: int | None = None, safety: Table | None = None) -> Path:
    """Write the report page into a suite's folder, and a video of each drive that it shows.

    Films that exist already are kept.

    Args:
        shown: number of drives to show, the lowest scores first. None: all.
        safety: table of safety tests, shown above all others.

    Raises:
        InputError: the folder holds no suite whose drives are all complete.
    """
    # The metrics may not be in place yet: they can be held back to appear with this report
    if not latest(out / SUMMARY).is_file():
        raise InputError(f"{out}: not a suite of drives (no {SUMMARY})")
    title = suite_title(out)
    drives = {path.stem: read_drive(path) for path in sorted((out / DRIVES).glob("*.json"), key=_order)}
    worst_first = sorted(drives, key=lambda name: _badness(drives[name]))[:shown]
    for name in worst_first:
        drive, video = drives[name], out / VIDEOS / f"{name}.webp"
        if not video.is_file():
            write_drive_video(video, LogPath(out / drive.log, out / "maps"), drive, lanes_of_suite(out))
    summary = read_summary(out / SUMMARY)
    write_page(
        out / REPORT,
        "drive_report.html.j2",
        title=title,
        provenance=Provenance.of(summary),
        # Safety tests have scores of their own in place of the leaderboards'
        tiles=_tiles(summary)[0 if safety is None else len(LEADERBOARDS) :],
        endings=_counted(summary, "endings", Ending),
        scenarios=_counted(summary, "scenarios", ScenarioKind),
        infractions=_infraction_table(summary),
        letters={LETTERS[kind]: words(kind) for kind in LETTERS if summary[f"infractions.{kind}"]},
        safety=safety,
        table=_drive_table(drives, set(worst_first)),
        drives=[_show_drive(name, drives[name]) for name in worst_first],
        near_collision_s=f"{NEAR_COLLISION_S:g}",
        all_metrics=full_table(summary),
    )
    return out / REPORT


def _tiles(summary: Summary) -> list[MetricTile]:
    has_repetitions, tiles = _repeated(summary), []
    for key, name in SCORES.items():
        spread = f"± {number(summary[f'{key}.spread'], 1)} over repetitions"
        tiles.append(
            MetricTile(name, number(summary[key], 1), note=spread if has_repetitions else "one repetition")
        )
    failed, near = number(summary["failed"]), _percent(summary["near_collision_share"])
    comfortable = _percent(summary["comfortable_share"])
    if "trusted_share" in summary:
        trusted = _percent(summary["trusted_share"])
        tiles.append(MetricTile("Trusted key frames, %", trusted, note="where good images are expected"))
    return [
        *tiles,
        MetricTile("Failed drives", failed, note=f"of {number(summary['drives'])}"),
        MetricTile("Comfortable time, %", comfortable, note="within nuPlan's bounds"),
        MetricTile("Near collision, % of time", near, note=f"time to collision below {NEAR_COLLISION_S:g} s"),
        MetricTile("Planning time", number(summary["plan_ms"], 0), "ms", "median"),
    ]


def _number_of(count: Value, name: str) -> str:
    return f"{number(count)} {name}" + ("" if count == 1 else "s")


def _repeated(summary: Summary) -> bool:
    repetitions = summary["repetitions"]
    return isinstance(repetitions, int) and repetitions > 1


def _percent(share: Value) -> str:
    return number(100 * share, 1) if isinstance(share, float | int) else MISSING


def _infractions(summary: Summary) -> list[tuple[InfractionKind, Value, Value]]:
    """Return the kinds of infractions that occurred, with their number and their number per kilometre."""
    return [
        (kind, count, summary[f"infractions_per_km.{kind}"])
        for kind in InfractionKind
        if (count := summary[f"infractions.{kind}"])
    ]


def _infraction_table(summary: Summary) -> Table | None:
    rows = [(words(kind), count, per_km) for kind, count, per_km in _infractions(summary)]
    columns = (Column("infraction", align="left"), Column("number"), Column("per km", digits=2))
    return simple_table(columns, rows) if rows else None


def _counted(summary: Summary, what: str, kinds: Iterable[str]) -> str:
    """Return one line with the number of each kind, such as "3 completed, 1 timeout"."""
    counts = {kind: summary[f"{what}.{kind}"] for kind in kinds}
    return ", ".join(f"{number(count)} {words(kind)}" for kind, count in counts.items() if count)


def _badness(drive: DriveRecord) -> tuple[float, float]:
    """Return a sort key: failed safety tests first, then low scores."""
    safety = 0.0 if drive.threat is None else (-1.0 if drive.threat.score is None else drive.threat.score)
    return safety, drive.driving_score_1_0


def _drive_table(drives: Mapping[str, DriveRecord], shown: set[str]) -> Table:
    is_safety = all(drive.threat is not None for drive in drives.values())
    columns = (
        Column("drive", align="left"),
        Column("length, m", digits=0),
        *_score_columns(is_safety),
        Column("completion, %", digits=0),
        Column("outside lanes, %", digits=1),
        Column("time, s", digits=0),
        Column("ending", align="left"),
        Column("infractions", align="left"),
    )
    return simple_table(
        columns, [_drive_row(name, drive, name in shown, is_safety) for name, drive in drives.items()]
    )


def _score_columns(is_safety: bool) -> tuple[Column, Column]:
    """Return the columns of the scores: those of safety tests, or of the leaderboards."""
    if is_safety:
        return Column("safety score", digits=2), Column("outcome", align="left")
    return Column("score 1.0", digits=1), Column("score 2.1", digits=1)


def _score_cells(drive: DriveRecord, is_safety: bool) -> tuple[Value | Cell, Value | Cell]:
    if not is_safety or drive.threat is None:
        return drive.driving_score_1_0, drive.driving_score_2_1
    outcome = drive.threat.outcome
    return drive.threat.score, Cell(words(outcome), "good" if outcome is Outcome.PASSED else "bad")


def _of_five(result: SafetyResult) -> str:
    return "not scored" if result.score is None else f"{result.score:.1f} of 5"


def _drive_row(name: str, drive: DriveRecord, is_shown: bool, is_safety: bool) -> list[Value | Cell]:
    score = drive.score
    return [
        Cell(name, link=name if is_shown else ""),
        drive.length_m,
        *_score_cells(drive, is_safety),
        100 * score.completion,
        100 * score.outside_lanes if drive.lanes_known else None,
        score.duration_s,
        Cell(words(score.ending), "good" if score.ending is Ending.COMPLETED else "bad"),
        ", ".join(words(infraction.kind) for infraction in score.infractions),
    ]


def _infraction_text(infraction: Infraction) -> str:
    """Return the object of an infraction and its detail; some details already begin with the object."""
    what, detail = infraction.what, infraction.detail
    return detail if detail.startswith(what) else f"{what} {detail}"


def _show_drive(name: str, drive: DriveRecord) -> ShownDrive:
    score = drive.score
    events = [
        DriveEvent(entry.t_s, words(entry.kind), _infraction_text(entry)) for entry in score.infractions
    ]
    events += [
        DriveEvent(event.t_s, f"scenario {place}", words(event.what))
        for place, event in enumerate(drive.scenario_events, start=1)
    ]
    events.sort(key=lambda entry: entry.t_s or 0.0)
    # The outcome of a threat concerns the whole drive and comes last
    if drive.threat is not None:
        events.append(DriveEvent(None, f"{words(drive.threat.kind)} threat", threat_text(drive.threat)))
    return ShownDrive(
        name=name,
        score=number(score.driving_score_1_0, 1) if drive.threat is None else _of_five(drive.threat),
        ending=words(score.ending if drive.threat is None else drive.threat.outcome),
        error=drive.error,
        path_plot=inline_svg(draw_drive_path(drive)),
        timeline=inline_svg(draw_timeline(drive)),
        events=events,
        video=f"{VIDEOS}/{quote(name)}.webp",
    )


def threat_text(met: SafetyResult) -> str:
    """Return the outcome of a threat, its score and the progress in one line."""
    outcome = words(met.outcome)
    if met.impact_mps is not None:
        outcome += f" at {met.impact_mps:.1f} m/s ({met.reference_mps:.1f} m/s without any action)"
    if met.score is None or met.score_progress is None:
        return f"{outcome}: not scored"
    return (
        f"{outcome}: score {met.score:.1f} of 5, progress {met.progress:.2f}, "
        f"score times progress {met.score_progress:.1f}"
    )


def _order(path: Path) -> tuple[list[int], str]:
    """Return a sort key that compares the numbers in a name as numbers."""
    parts = path.stem.replace("route", "").split("_rep")
    return [int(part) if part.isdigit() else 0 for part in parts], path.stem


@functools.lru_cache(maxsize=1)
def lanes_of_suite(out: Path) -> Lanes:
    """Return the lanes of the log in whose reconstruction the suite drove; none in towns or without a map."""
    from foredrive.runs.drive.in_reconstruction import lane_outlines_of  # imports renderers

    run = read_suite(out).get("run")
    return (lane_outlines_of(Path(run)) or []) if isinstance(run, str) else []
