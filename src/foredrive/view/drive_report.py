"""The report on a suite of closed-loop drives: scores, and each drive with its way, its speed and a film."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from urllib.parse import quote

from rich.table import Table

from foredrive.data.logs import LogPath
from foredrive.errors import InputError
from foredrive.evaluation.summary import read_summary
from foredrive.files import atomic_path
from foredrive.runs.drive.records import read_drive, suite_title
from foredrive.runs.folder import DRIVES, SUMMARY
from foredrive.simulation.drive_record import DriveRecord, ThreatMet
from foredrive.simulation.scenarios.kinds import ScenarioKind
from foredrive.simulation.scores import Ending, Infraction, InfractionKind
from foredrive.view.drive_plots import LETTERS, draw_timeline, draw_way
from foredrive.view.drive_video import write_drive_video
from foredrive.view.inline_svg import inline_svg
from foredrive.view.report_style import CSS
from foredrive.view.run_report import machine_line
from foredrive.view.summary_tables import MISSING, full_table, number

REPORT, VIDEOS = "report.html", "videos"
Summary = Mapping[str, float | int | str | None]
SCORES = {
    "driving_score_1_0": "Driving score, leaderboard 1.0",
    "driving_score_2_1": "Driving score, leaderboard 2.1",
    "completion": "Route completion, %",
}
DRIVE_CSS = """
.drive { display: grid; grid-template-columns: 300px 1fr; gap: .4rem 1.2rem; align-items: start; }
.drive .film { grid-column: 1 / -1; max-width: 768px; }
.good { color: var(--best); } .bad { color: var(--warn); font-weight: 650; }
@media screen and (max-width: 760px) { .drive { grid-template-columns: 1fr; } }
"""


def score_table(summary: Summary) -> Table:
    """The figures a reader looks for first, for the terminal."""
    title = f"{number(summary['routes'])} routes, {number(summary['repetitions'])} repetitions"
    table = Table(title=title, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(justify="right")
    for key, name in SCORES.items():
        spread = f" ± {number(summary[f'{key}.spread'], 1)}" if (summary["repetitions"] or 0) > 1 else ""  # type: ignore[operator]
        table.add_row(name, f"{number(summary[key], 1)}{spread}")
    table.add_section()
    for kind in InfractionKind:
        if summary[f"infractions.{kind}"]:
            per_km = number(summary[f"infractions_per_km.{kind}"], 2)
            table.add_row(_words(kind), f"{number(summary[f'infractions.{kind}'])}  ({per_km} / km)")
    for ending in Ending:
        if ending is not Ending.COMPLETED and summary[f"endings.{ending}"]:
            table.add_row(f"ended: {_words(ending)}", number(summary[f"endings.{ending}"]))
    table.add_section()
    table.add_row("Drives that the agent failed at", number(summary["failed"]))
    table.add_row("Time of a plan, ms", number(summary["plan_ms"], 0))
    return table


def write_drive_report(out: Path) -> Path:
    """Write the page about a suite's folder, and a film of each drive beside it; films that are there stay.

    Raises:
        InputError: the folder holds no suite that has been driven to its end.
    """
    if not (out / SUMMARY).is_file():
        raise InputError(f"{out}: not a suite of drives (no {SUMMARY})")
    title = suite_title(out)
    drives = {path.stem: read_drive(path) for path in sorted((out / DRIVES).glob("*.json"), key=_order)}
    for name, drive in drives.items():
        film = out / VIDEOS / f"{name}.webp"
        if not film.is_file():
            write_drive_video(film, LogPath(out / drive.log, out / "maps"), drive)
    page = _page(title, read_summary(out / SUMMARY), drives)
    with atomic_path(out / REPORT) as scratch:
        scratch.write_text(page, encoding="utf-8")
    return out / REPORT


def _page(title: str, summary: Summary, drives: Mapping[str, DriveRecord]) -> str:
    worst_first = sorted(drives, key=lambda name: drives[name].driving_score_1_0)
    parts = [
        f"<h1>{escape(title)}</h1>",
        _run(summary),
        f"<section><h2>In short</h2>{_tiles(summary)}{_infraction_table(summary)}</section>",
        f"<section><h2>Drives</h2>{_legend(summary)}{_drive_table(drives)}</section>",
        "<section><h2>One by one, the worst first</h2>",
        *(_drive(name, drives[name]) for name in worst_first),
        "</section>",
        f"<details><summary>Every figure</summary>{full_table(summary)}</details>",
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}{DRIVE_CSS}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _run(summary: Summary) -> str:
    rows = {
        "command": f"<code>{escape(str(summary.get('command')))}</code>",
        "commit": f"<code>{escape(str(summary.get('commit')))}</code>",
        "machine": escape(machine_line(summary)),
    }
    return '<dl class="run">' + "".join(f"<dt>{k}</dt><dd>{v}</dd>" for k, v in rows.items()) + "</dl>"


def _tiles(summary: Summary) -> str:
    again = (summary["repetitions"] or 0) > 1  # type: ignore[operator]
    tiles = []
    for key, name in SCORES.items():
        spread = f"&plusmn; {number(summary[f'{key}.spread'], 1)} over repetitions"
        tiles.append((name, number(summary[key], 1), spread if again else "one repetition"))
    tiles.append(("Drives the agent failed at", number(summary["failed"]), f"of {number(summary['drives'])}"))
    tiles.append(("Comfortable time, %", _percent(summary["comfortable_share"]), "within nuPlan's bounds"))
    tiles.append(
        ("Near collision, % of time", _percent(summary["near_collision_share"]), "less than 0.95 s away")
    )
    tiles.append(("Time of a plan", f"{number(summary['plan_ms'], 0)} <small>ms</small>", "median"))
    shown = "".join(
        f'<div class="tile"><div class="name">{name}</div><div class="value">{value}</div>'
        f'<div class="name">{note}</div></div>'
        for name, value, note in tiles
    )
    return f'<div class="tiles">{shown}</div>'


def _percent(share: float | int | str | None) -> str:
    return "&ndash;" if not isinstance(share, float | int) else number(100 * share, 1)


def _infraction_table(summary: Summary) -> str:
    rows = "".join(
        f'<tr><th scope="row">{_words(kind)}</th><td>{number(summary[f"infractions.{kind}"])}</td>'
        f"<td>{number(summary[f'infractions_per_km.{kind}'], 2)}</td></tr>"
        for kind in InfractionKind
        if summary[f"infractions.{kind}"]
    )
    endings = ", ".join(
        f"{number(summary[f'endings.{ending}'])} {_words(ending)}"
        for ending in Ending
        if summary[f"endings.{ending}"]
    )
    begun = ", ".join(
        f"{number(summary[f'scenarios.{kind}'])} {_words(kind)}"
        for kind in ScenarioKind
        if summary[f"scenarios.{kind}"]
    )
    head = '<tr><th scope="row">infraction</th><th>number</th><th>per km</th></tr>'
    told = f"<p>Endings: {endings}.</p><p>Scenarios begun: {begun or 'none'}.</p>"
    return told + (f"<table>{head}{rows}</table>" if rows else "")


def _legend(summary: Summary) -> str:
    found = [kind for kind in LETTERS if summary[f"infractions.{kind}"]]
    letters = ", ".join(f"<b>{LETTERS[kind]}</b> {_words(kind)}" for kind in found)
    return (
        '<p class="note">In the maps the route is grey and the way driven coloured by speed, from violet (0) '
        f"to yellow (14 m/s). Violet numbers: scenarios that begin. {f'Red: {letters}. ' if letters else ''}"
        "Orange: somebody less than 0.95 s from being touched.</p>"
    )


def _drive_table(drives: Mapping[str, DriveRecord]) -> str:
    head = (
        '<tr><th scope="row">drive</th><th>length, m</th><th>score 1.0</th><th>score 2.1</th>'
        "<th>completion, %</th><th>outside lanes, %</th><th>time, s</th>"
        '<th class="text">ending</th><th class="text">infractions</th></tr>'
    )
    rows = [_drive_row(name, drive) for name, drive in drives.items()]
    return f'<div class="scroll"><table>{head}{"".join(rows)}</table></div>'


def _drive_row(name: str, drive: DriveRecord) -> str:
    score = drive.score
    wrong = ", ".join(_words(infraction.kind) for infraction in score.infractions)
    known = drive.lanes_known
    outside = number(100 * score.outside_lanes, 1) if known else MISSING
    mark = "good" if score.ending is Ending.COMPLETED else "bad"
    return (
        f'<tr><th scope="row"><a href="#{escape(name)}">{escape(name)}</a></th>'
        f"<td>{number(drive.length_m, 0)}</td>"
        f"<td>{number(score.driving_score_1_0, 1)}</td><td>{number(score.driving_score_2_1, 1)}</td>"
        f"<td>{number(100 * score.completion, 0)}</td><td>{outside}</td>"
        f'<td>{number(score.duration_s, 0)}</td><td class="text {mark}">{_words(score.ending)}</td>'
        f'<td class="text">{wrong}</td></tr>'
    )


def _told(infraction: Infraction) -> str:
    """What was met, and how; some details begin with what it was."""
    what, detail = infraction.what, infraction.detail
    return detail if detail.startswith(what) else f"{what} {detail}"


def _drive(name: str, drive: DriveRecord) -> str:
    score = drive.score
    error = f'<p class="alert">{escape(drive.error)}</p>' if drive.error else ""
    lines = [
        (
            infraction.t_s,
            f"<b>{_words(infraction.kind)}</b> {escape(_told(infraction))}",
        )
        for infraction in score.infractions
    ]
    lines += [
        (event.t_s, f"scenario {place}: {_words(event.what)}")
        for place, event in enumerate(drive.scenario_events, start=1)
    ]
    told = "".join(f"<li>{t_s:.1f} s: {text}</li>" for t_s, text in sorted(lines))
    if drive.threat is not None:
        told += f"<li>{_threat(drive.threat)}</li>"
    return (
        f'<h3 id="{escape(name)}">{escape(name)}: {number(score.driving_score_1_0, 1)}, '
        f"{_words(score.ending)}</h3>"
        f"{error}"
        f'<div class="drive"><figure>{inline_svg(draw_way(drive))}</figure>'
        f"<div><figure>{inline_svg(draw_timeline(drive))}</figure><ul>{told}</ul></div>"
        f'<figure class="film"><img loading="lazy" src="{VIDEOS}/{quote(name)}.webp" alt="film of the drive">'
        "</figure></div>"
    )


def _threat(met: ThreatMet) -> str:
    """What came of a threat, in a line."""
    hit = "not hit" if met.impact_mps is None else f"hit at {met.impact_mps:.1f} m/s"
    by_the_log = f"{met.reference_mps:.1f} m/s by who goes on as the log did"
    return f"<b>{_words(met.kind)} threat</b>: {hit} ({by_the_log}), score {met.score:.1f} of 5"


def _words(name: str) -> str:
    """A name with blanks, as text of the page."""
    return escape(str(name).replace("_", " "))


def _order(path: Path) -> tuple[list[int], str]:
    """Numbers in names as numbers."""
    parts = path.stem.replace("route", "").split("_rep")
    return [int(part) if part.isdigit() else 0 for part in parts], path.stem
