"""The report on a comparison of agents over the same routes."""

import statistics
from pathlib import Path

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from foredrive.runs.drive.compare import METRICS, Comparison
from foredrive.tasks.bootstrap import LEAST_ROUTES, NO_INTERVAL, BootstrapMean
from foredrive.view.html import INK_MARK, inline_svg, style_axes, write_page
from foredrive.view.table import MISSING, Cell, Column, Row, Section, Table, number, simple_table

REPORT = "report.html"
TITLES = {
    "driving_score_1_0": "Driving score, leaderboard 1.0",
    "driving_score_2_1": "Driving score, leaderboard 2.1",
    "completion": "Route completion, %",
    "red_lights": "Red lights, per drive",
    "collisions": "Collisions, per drive",
    "stop_signs": "Stop signs, per drive",
    "speed_mps": "Mean speed, m/s",
}
WORSE_IF_MORE = ("red_lights", "collisions", "stop_signs")
DIGITS = {"red_lights": 2, "collisions": 2, "stop_signs": 2, "speed_mps": 2}
NEUTRAL = ("speed_mps",)


def means_table(comparison: Comparison) -> Table:
    """Return the mean of each metric for each agent, and its difference from the first agent."""
    first, *others = comparison.agents
    columns = [Column(align="left"), Column(first.name, wraps=False)]
    for agent in others:
        columns += [Column("mean", agent.name), Column("difference", agent.name, wraps=False)]
    rows = []
    for metric in METRICS:
        digits = DIGITS.get(metric, 1)
        cells: list[Cell | str | float | None] = [TITLES[metric]]
        cells.append(number(statistics.fmean(first.values(metric, comparison.keys)), digits))
        for agent in others:
            mean = statistics.fmean(agent.values(metric, comparison.keys))
            cells.append(number(mean, digits))
            cells.append(_difference(metric, comparison.differences[metric][agent.name], digits))
        rows.append(Row(cells))
    over = f"Intervals of 95 % over {comparison.differences_over}, paired by route"
    intervals = (
        NO_INTERVAL
        if len(comparison.routes) < LEAST_ROUTES
        else f"{over}; coloured where the interval leaves out 0."
    )
    notes = [
        f"Drives that all agents have: {len(comparison.keys)}, on {len(comparison.routes)} routes. "
        f"Differences from {first.name}. {intervals}"
    ]
    if comparison.left_out:
        notes.append(f"{comparison.left_out} drives are left out: not all agents have them.")
    if comparison.unlike:
        notes.append(
            f"The folders differ in {'; '.join(comparison.unlike)}: the drives of a pair did not meet the "
            "same traffic."
        )
    return Table(columns, [Section(rows)], "Agents side by side", notes)


def ranking_table(comparison: Comparison) -> Table:
    """Return the agents in the order of their abilities."""
    columns = [
        Column("agent", align="left"),
        Column("rank"),
        Column("ability, logits", wraps=False),
        Column("drives"),
        Column("mean score", digits=1),
        Column("failed"),
    ]
    rows = []
    for agent, ability, rank in zip(
        comparison.agents, comparison.ratings.ability, comparison.ratings.rank, strict=True
    ):
        scores = [drive.driving_score_1_0 for drive in agent.drives.values() if not drive.score.failed]
        places, logits = f"{rank.value:.3g}", f"{ability.value:+.2f}"
        if not np.isnan(rank.low):  # NaN with few routes
            places += f" [{rank.low:.3g}, {rank.high:.3g}]"
            logits += f" [{ability.low:+.2f}, {ability.high:+.2f}]"
        cells: list[Cell | str | float | None] = [agent.name, places, logits, len(scores)]
        rows.append((-ability.value, [*cells, statistics.fmean(scores), agent.failed]))
    rows.sort(key=lambda row: row[0])
    few = len(comparison.rated_routes) < LEAST_ROUTES
    notes = [
        "By an item-response model of all drives of each agent: the logit of an expected score is the "
        "ability minus the difficulty of the route. Drives in which the agent itself failed count for "
        "nothing. " + (NO_INTERVAL if few else f"Intervals of 95 % over {comparison.ratings_over}.")
    ]
    return Table(columns, [Section([Row(cells) for _, cells in rows])], "Ranking", notes)


def difficulties_table(comparison: Comparison) -> Table:
    """Return the routes, the hardest first."""
    columns = [Column("route", align="left"), Column("difficulty, logits", wraps=False)]
    hardest = sorted(
        zip(comparison.rated_routes, comparison.ratings.difficulty, strict=True),
        key=lambda row: -row[1].value,
    )
    rows: list[list[Cell | str | float | None]] = [
        [route, f"{of.value:+.2f} [{of.low:+.2f}, {of.high:+.2f}]"] for route, of in hardest
    ]
    return simple_table(columns, rows, "Difficulty of the routes")


def routes_table(comparison: Comparison, shown: int | None = None) -> Table:
    """Return the routes with their events, those that separate the agents most first."""
    columns = [Column("route", align="left")]
    for agent in comparison.agents:
        columns += [Column("score", agent.name, digits=0), Column("events", agent.name, align="left")]
    rows = []
    for row in comparison.routes[:shown]:
        cells: list[Cell | str | float | None] = [row.route]
        best = max(row.scores)
        for score, happened in zip(row.scores, row.happened, strict=True):
            cells += [Cell(score, "best" if score == best and row.spread > 0 else ""), happened or MISSING]
        rows.append(cells)
    title = "Routes that separate the agents" if shown else "All routes, the most separating first"
    return simple_table(columns, rows, title)


def drives_table(comparison: Comparison) -> Table:
    """Return route × repetition with the score and completion of each agent."""
    columns = [Column("route", align="left"), Column("repetition")]
    for agent in comparison.agents:
        columns += [Column("score", agent.name, digits=1), Column("completion, %", agent.name, digits=1)]
    several = any(len(agent.folders) > 1 for agent in comparison.agents)
    rows = []
    for key in comparison.keys:
        route, place, repetition = key
        cells: list[Cell | str | float | None] = [route, f"{place}.{repetition}" if several else repetition]
        for agent in comparison.agents:
            drive = agent.drives[key]
            cells += [drive.driving_score_1_0, 100.0 * drive.score.completion]
        rows.append(cells)
    return simple_table(columns, rows, "Every drive")


def write_compare_report(path: Path, comparison: Comparison) -> None:
    """Write the page of a comparison."""
    write_page(
        path,
        "compare_report.html.j2",
        title=", ".join(agent.name for agent in comparison.agents),
        means=means_table(comparison),
        ranking=ranking_table(comparison),
        difficulties=difficulties_table(comparison),
        scatters=[_scatter(comparison, other) for other in range(1, len(comparison.agents))],
        routes=routes_table(comparison),
        drives=drives_table(comparison),
    )


def _difference(metric: str, mean: BootstrapMean, digits: int) -> Cell:
    text = f"{mean.mean:+z.{digits}f}"
    if np.isnan(mean.low):
        return Cell(text)
    text += f" [{mean.low:z.{digits}f}, {mean.high:z.{digits}f}]"
    # Coloured only where the interval leaves out 0, and where more or less is better
    if mean.low <= 0 <= mean.high or metric in NEUTRAL:
        return Cell(text)
    better = (mean.mean > 0) != (metric in WORSE_IF_MORE)
    return Cell(text, "good" if better else "bad")


def _scatter(comparison: Comparison, other: int) -> Markup:
    """Draw the score of each route for the first agent and another one."""
    first, second = comparison.agents[0], comparison.agents[other]
    with mpl.rc_context({"font.family": "DejaVu Sans"}):
        figure = Figure(figsize=(4.2, 4.0), layout="constrained")
        ax = figure.add_subplot()
        scores = np.array([[row.scores[0], row.scores[other]] for row in comparison.routes])
        ax.plot([0, 100], [0, 100], color=INK_MARK, alpha=0.3, linewidth=1)
        ax.scatter(scores[:, 0], scores[:, 1], s=36, alpha=0.45, color="#2a78c8", linewidths=0)
        for row in comparison.routes[:5]:
            if row.spread > 0:
                ax.annotate(
                    row.route,
                    (row.scores[0], row.scores[other]),
                    xytext=(5, 3),
                    textcoords="offset points",
                    fontsize=8,
                    color=INK_MARK,
                )
        style_axes(ax, "Driving score of each route", first.name, second.name)
        ax.set(xlim=(-4, 104), ylim=(-4, 104), aspect="equal")
        return inline_svg(figure)
