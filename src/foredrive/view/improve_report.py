"""The report on rounds of the loop: scores, failures, what was chosen for them, films before and after."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from foredrive.data.log_paths import LogPath
from foredrive.driving.drive_record import DriveRecord
from foredrive.engine.folder import SUMMARY, held_for_results
from foredrive.engine.provenance import collect_provenance
from foredrive.engine.summary import write_summary
from foredrive.runs.drive.compare import values_of
from foredrive.runs.improve.failures import Failure, counted
from foredrive.runs.improve.records import Judged, LoopResult, Round, ScoredMoment
from foredrive.search.find import Hit
from foredrive.tasks.bootstrap import LEAST_ROUTES, NO_INTERVAL, BootstrapMean, bootstrap_mean
from foredrive.view.drive_plots import draw_places, letter_of
from foredrive.view.drive_report import lanes_of_suite
from foredrive.view.drive_video import write_drive_video
from foredrive.view.hit_picture import content_text, hit_name, hit_picture
from foredrive.view.html import Picture, inline_svg, picture, write_page
from foredrive.view.table import Column, Row, Section, Table, number, words

REPORT, VIDEOS = "report.html", "videos"
FILMS, FAILURES_SHOWN = 3, 12
DRIVE_COLUMNS = {
    "completion": "completion, %",
    "red_lights": "red lights",
    "collisions": "collisions",
    "stop_signs": "stop signs",
}
"""Values of drives beside the score; counts are per drive."""
MOMENT_COLUMNS = {"missed": "missed", "false": "false", "localisation": "localisation"}
"""Parts of the negative log-likelihood of moments, nats."""


class AnsweredFailure(NamedTuple):
    """A failure and the chosen moments that resemble it most."""

    caption: str
    moment: Picture
    chosen: list[Picture]


class Films(NamedTuple):
    """The drives of one route in two rounds."""

    caption: str
    before: str
    after: str


class ShownRound(NamedTuple):
    """What the page shows of a round."""

    title: str
    failures: str
    places: list[tuple[str, Markup]]
    """Maps of the towns, with the failures."""
    letters: str
    """The letters of the maps, in words."""
    answers: list[AnsweredFailure]
    films: list[Films]


def rounds_table(result: LoopResult) -> Table:
    """Return what judges each round, with differences from the run at the beginning."""
    first = result.rounds[0]
    title, columns_of = _of_kind(first)
    columns = [
        Column("round", align="left"),
        Column("chosen moments"),
        Column(title, digits=1),
        Column("difference", wraps=False),
        *[Column(name, digits=2) for name in columns_of.values()],
        Column("", align="left"),
    ]
    rows = []
    for of_number in result.rounds:
        figures = _means(of_number)
        change = "" if not of_number.number else _change(difference(first, of_number))
        taken = "" if of_number.kept else "dropped"
        name = "begin" if not of_number.number else str(of_number.number)
        values = [figures[column] for column in columns_of]
        rows.append(Row([name, len(of_number.hits) or None, of_number.score, change, *values, taken]))
    groups = len({_group(item) for item in first.judged.values()})
    items, kind = ("Drives", "routes") if columns_of is DRIVE_COLUMNS else ("Moments", "logs")
    intervals = (
        f"Intervals of 95 % (paired bootstrap over {kind})."
        if groups >= LEAST_ROUTES
        else NO_INTERVAL.replace("routes", kind)
    )
    count = f"{items}: {len(first.judged)}; other columns are means over them."
    unscored = sum(len(of_number.judged) - len(of_number.scores) for of_number in result.rounds)
    left_out = f" {unscored} drives of all rounds have no score and are left out." if unscored else ""
    note = f"{count} Differences are from the beginning.{left_out}"
    return Table(columns, [Section(rows)], "Rounds", [f"{note} {intervals}"])


def difference(first: Round, other: Round) -> BootstrapMean:
    """Return the mean difference of the scores of two rounds, over what has a score in both."""
    before, after = first.scores, other.scores
    names = [name for name in before if name in after]
    gains = [after[name] - before[name] for name in names]
    groups = [_group(first.judged[name]) for name in names]
    return bootstrap_mean(np.array(gains), groups, np.random.default_rng(0), least=LEAST_ROUTES)


def write_improve_report(out: Path, result: LoopResult, state: str = "") -> None:
    """Write the page of a loop into its folder, and the films that it shows; at the end summary.json too.

    Args:
        state: what the loop is doing; the page then loads itself again. Empty at the end.
    """
    rounds = [_show(out, result, number) for number in range(1, len(result.rounds))]
    with held_for_results(out):
        if not state:
            write_summary(out / SUMMARY, figures_of(result) | collect_provenance())
        write_page(
            out / REPORT,
            "improve_report.html.j2",
            title="Rounds of the loop",
            rounds=rounds,
            table=rounds_table(result) if result.rounds else None,
            ended=result.ended,
            state=state,
        )


def figures_of(result: LoopResult) -> dict[str, float | int | str | None]:
    """Return the figures of all rounds as flat dotted keys."""
    out: dict[str, float | int | str | None] = {"rounds": len(result.rounds) - 1, "kept": result.best.number}
    for of_number in result.rounds:
        prefix = f"round_{of_number.number}"
        out |= {f"{prefix}.{name}": value for name, value in _means(of_number).items()}
        out |= {
            f"{prefix}.judged": len(of_number.judged),
            f"{prefix}.moments": len(of_number.hits),
            f"{prefix}.failures": len(of_number.failures),
            f"{prefix}.kept": int(of_number.kept),
        }
    return out


def _of_kind(of_number: Round) -> tuple[str, dict[str, str]]:
    """Return the title of the score of what judges a round, and the titles of further values by name."""
    items = list(of_number.judged.values())
    if any(isinstance(item, ScoredMoment) for item in items):
        return "log-likelihood, nats", MOMENT_COLUMNS
    threats = any(isinstance(item, DriveRecord) and item.threat is not None for item in items)
    return "NeuroNCAP score times progress, % of 5" if threats else "driving score", DRIVE_COLUMNS


def _group(item: Judged) -> str:
    return item.log if isinstance(item, ScoredMoment) else item.score.route


def _values(item: Judged) -> dict[str, float]:
    if isinstance(item, DriveRecord):
        return values_of(item)
    return {name: getattr(item, name) for name in ("nll", *MOMENT_COLUMNS)}


def _means(of_number: Round) -> dict[str, float]:
    values = [_values(item) for item in of_number.judged.values()]
    return {name: float(np.mean([row[name] for row in values])) for name in values[0]}


def _change(gain: BootstrapMean) -> str:
    text = f"{gain.mean:+.1f}"
    return text if np.isnan(gain.low) else f"{text} [{gain.low:+.1f}, {gain.high:+.1f}]"


def _show(out: Path, result: LoopResult, place: int) -> ShownRound:
    of_number = result.rounds[place]
    before = [earlier for earlier in result.rounds[:place] if earlier.kept][-1]
    kinds = [failure.kind for failure in of_number.failures]
    moved = "" if of_number.kept else ", dropped"
    return ShownRound(
        f"Round {of_number.number}: {number(before.score, 1)} to {number(of_number.score, 1)}{moved}",
        f"{counted(of_number.failures)}; {len(of_number.hits)} moments chosen.",
        _maps(of_number.failures),
        ", ".join(f"{letter_of(kind)} {words(kind)}" for kind in dict.fromkeys(kinds)),
        answered(of_number),
        _films(out, before, of_number),
    )


def _maps(failures: Sequence[Failure]) -> list[tuple[str, Markup]]:
    towns = sorted({failure.town for failure in failures if failure.town is not None})
    return [
        (
            town,
            inline_svg(
                draw_places(
                    town,
                    [(failure.xy_world, failure.kind) for failure in failures if failure.town == town],
                )
            ),
        )
        for town in towns
    ]


def answered(of_number: Round) -> list[AnsweredFailure]:
    """Return failures of a round with pictures of the moment before each and of what was chosen for it."""
    # Evenly over all, so that each kind of failure has a chance
    count = len(of_number.answers)
    shown = np.linspace(0, count - 1, min(count, FAILURES_SHOWN)).round().astype(int).tolist()
    return [
        AnsweredFailure(
            answer.failure.name + (f": {answer.failure.what}" if answer.failure.what else ""),
            _picture(answer.moment),
            [_picture(hit) for hit in answer.hits],
        )
        for answer in (of_number.answers[place] for place in shown)
    ]


def _picture(hit: Hit) -> Picture:
    name = hit_name(hit).rpartition("/")[0]
    return picture(hit_picture(hit, lidar=False), f"{name}: {content_text(hit)}")


def _films(out: Path, before: Round, after: Round) -> list[Films]:
    """Write films of the judged drives whose scores changed most; moments have none."""
    old, new = before.scores, after.scores
    drives = [name for name in old if name in new and isinstance(after.judged[name], DriveRecord)]
    changed = sorted((name for name in drives if new[name] != old[name]), key=lambda n: -abs(new[n] - old[n]))
    return [
        Films(
            f"{name}: {number(old[name], 1)} to {number(new[name], 1)}",
            *[quote(str(film_of(of_number, name).relative_to(out))) for of_number in (before, after)],
        )
        for name in changed[:FILMS]
    ]


def film_of(of_number: Round, name: str) -> Path:
    """Return the film of a drive that judges a round; write it if it is missing."""
    suite, drive = of_number.suite, of_number.judged[name]
    assert suite is not None
    assert isinstance(drive, DriveRecord)
    film = suite / VIDEOS / f"{name}.webp"
    if not film.is_file():
        write_drive_video(film, LogPath(suite / drive.log, suite / "maps"), drive, lanes_of_suite(suite))
    return film
