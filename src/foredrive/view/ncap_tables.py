"""Tables of safety tests: each scenario, each kind, and the mean of the kinds."""

from collections.abc import Mapping, Sequence

from foredrive.driving.ncap.aggregation import Interval, SafetyFigures, TestedRun, aggregate
from foredrive.tasks.bootstrap import LEAST_ROUTES
from foredrive.view.table import Cell, Column, Row, Section, Table, Value, number, words

COLUMNS = (
    Column(align="left"),
    Column("runs"),
    Column("failed"),
    Column("score"),
    Column("collisions, %"),
    Column("progress", digits=2),
    Column("score by progress", digits=2),
    Column("impact speed", digits=2),
    Column("TTC, s", digits=1),
    Column("comfort, %", digits=0),
    Column("HD-Score", digits=2),
    Column("stopped short"),
    Column("left way"),
    Column("trusted, %", digits=0),
    Column("untrusted"),
)


def safety_table(runs: Sequence[TestedRun], left_out: Mapping[str, str]) -> Table:
    """Return the figures of a suite with their 95 % intervals.

    Args:
        left_out: reason for each scenario that the self-test left out.
    """
    scenarios, kinds, overall = aggregate(runs)
    notes = [
        f"score: 0 to 5; in brackets 95 % intervals: of a scenario over its runs, of kinds over places, from "
        f"{LEAST_ROUTES} on; score by progress: mean of their product",
        "impact speed: share of the reference speed, of runs with a collision; TTC: median of the smallest "
        "time to collision of each run",
        "trusted: share of the key frames in which the reconstruction expects good images; untrusted: runs "
        "that ended where it does not (--stay-trusted)",
        *(f"left out, {label}: {why}" for label, why in left_out.items()),
    ]
    sections = [
        Section([_row(name, figures) for name, figures in scenarios.items()]),
        Section([_row(words(kind), figures) for kind, figures in kinds.items()]),
        Section([_row(f"mean of {len(kinds)} kind{'s' if len(kinds) > 1 else ''}", overall, is_strong=True)]),
    ]
    return Table(COLUMNS, sections, notes=notes)


def _row(name: str, of: SafetyFigures, is_strong: bool = False) -> Row:
    comfort = None if of.comfortable_share is None else 100 * of.comfortable_share
    cells: list[Value | Cell] = [
        name,
        of.runs,
        Cell(of.failed, "bad" if of.failed else ""),
        _interval(of.score, 2),
        _interval(of.collision_rate, 0, 100.0),
        of.progress,
        of.score_progress,
        of.relative_impact_speed,
        of.time_to_collision_s,
        comfort,
        of.hd_score,
        of.stopped_short,
        of.left_way,
        None if of.trusted_share is None else 100 * of.trusted_share,
        of.untrusted,
    ]
    return Row(cells, is_strong)


def _interval(of: Interval | None, digits: int, factor: float = 1.0) -> str:
    if of is None:
        return number(None)
    mean = number(factor * of.mean, digits)
    if of.low is None or of.high is None:
        return mean
    return f"{mean} [{number(factor * of.low, digits)}, {number(factor * of.high, digits)}]"
