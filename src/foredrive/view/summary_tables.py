"""Tables of a summary's metrics. A missing value is shown as a dash; a table without values is None."""

import math
import re
from collections.abc import Sequence

from rich.console import Console

from foredrive.engine.summary import Summary
from foredrive.tasks.metric import CEILING, PRIOR, EvaluationContext
from foredrive.tasks.occupancy.scores import ABOVE_GROUND_M
from foredrive.tasks.planning.protocols import HORIZON_NAMES, PROTOCOLS
from foredrive.view.table import (
    MISSING,
    Cell,
    Column,
    Row,
    Section,
    Table,
    Value,
    number,
    print_table,
    simple_table,
    words,
)

ABOVE_NOTE = f"Above the ground: voxels more than {ABOVE_GROUND_M:g} m above it."
BASELINES_NOTE = (
    "Occupancy prior: the fixed grid that scores best on the training logs. Persistence: the predicted "
    "present in place of the future. Ego-compensated persistence: the same, moved along the driven path, "
    "which the model is not told. Persistence, motion continued: moved as if the vehicle went on as measured."
)
CEILING_NOTE = "Ceiling of true motion: the true present, moved along with its true flow and the driven path."
MOVING_NOTE = (
    "Where things move: the voxels that they fill at one of the frames up to then, and those next to them."
)
FUTURES_NOTE = "Best and mean of K: sampled futures."
BEST_NOTE = "Green: best of its column. The protocols differ: compare values of one column only."
INVALID_NOTE = (
    "Invalid frames have no complete driven future. UniAD's protocol counts the steps that they have, the "
    "others leave them out."
)
MODEL = ""
AGENT_TITLES = {MODEL: "this model", "ego_mlp": "ego-only MLP"}
WHENS = (*HORIZON_NAMES, "avg")
SCOPE_TITLES = {
    "": "all voxels",
    "above_ground.": "above the ground",
    "moving.": "above the ground, where things move",
    "standing.": "above the ground, elsewhere",
}
OCCUPANCY_TITLES = {"iou": "IoU", "precision": "precision", "recall": "recall"}
BASELINE_TITLES = {
    PRIOR: "occupancy prior",
    "copy": "persistence",
    "carried_copy": "ego-compensated persistence",
    "continued_copy": "persistence, motion continued",
    CEILING: "ceiling of true motion",
}
"""Titles of the baselines by their keys in summary.json."""
_BASELINE = re.compile(r"occupancy\.iou_\w+\.(\w+)")
_PLANNING = re.compile(rf"planning\.(?:(\w+)\.)?({'|'.join(PROTOCOLS)})\.\w+")
_OCCUPANCY = re.compile(r"occupancy\.iou_(\w+)")
_FLOW = re.compile(r"flow\.epe_moving_(\w+)_mps")
_VEHICLES = re.compile(r"vehicles\.car_recall_(\d+)m")
_IMAGES = re.compile(r"(\w+(?:\.\w+)*)\.psnr_db")


def print_summary(summary: Summary, console: Console, model: str) -> None:
    """Print the main metrics."""
    for make in (occupancy_table, vehicle_table, planning_table, flow_table, image_table, task_table):
        if table := make(summary):
            print_table(table, console)
    console.print(
        f"{model}: {clips_text(summary) or number(summary.get('items')) + ' clips'}; "
        f"{number(summary.get('failed'))} failed; "
        f"commands from: {summary.get('command_source', 'none')}; "
        f"peak memory {number(summary.get('peak_rss_gib'), 2)} GiB, {number(summary.get('wall_s'), 0)} s",
        markup=False,
        highlight=False,
    )


def clips_text(summary: Summary) -> str | None:
    """Return how many clips were judged, and why other times were not; None if a summary does not say."""
    if "clips.past_s" not in summary:
        return None
    reasons = {
        "past": f"without {number(summary['clips.past_s'], 1)} s before them",
        "future": f"without {number(summary['clips.future_s'], 1)} s after them",
        "gap": "with missing frames",
        "unseen": "without image and sweep",
    }
    counts = {text: summary.get(f"clips.left_out.{reason}") for reason, text in reasons.items()}
    left_out = ", ".join(f"{number(count)} {text}" for text, count in counts.items() if count)
    every = number(summary["clips.stride_s"], 2)
    return f"{number(summary.get('items'))} clips, one every {every} s; times left out: {left_out or 'none'}"


def time_title(name: str) -> str:
    """Return the title of a time: `future_500ms` becomes "+500 ms"; `now` stays."""
    later = re.fullmatch(r"future_(\d+)(ms|s)", name)
    return f"+{later[1]} {later[2]}" if later else name


def planning_overview(summary: Summary) -> Table | None:
    """Compare agents by their average scores under all protocols; mark the best value of each column."""
    agents, protocols = _planning_methods(summary)
    if not protocols:
        return None
    scores = [
        (Column(title, PROTOCOLS[protocol].title, 2), f"{protocol}.{metric}")
        for protocol in protocols
        for title, metric in (("L2, m", "l2_avg_m"), ("collisions, %", "collision_avg_pct"))
    ]
    columns = [Column(align="left"), *(column for column, _ in scores)]
    rows = _planning_rows(summary, agents, [key for _, key in scores])
    return Table(columns, [Section(rows)], notes=[BEST_NOTE])


def planning_table(summary: Summary) -> Table | None:
    """Compare agents at every horizon under each protocol; mark the best value of each column."""
    agents, protocols = _planning_methods(summary)
    if not protocols:
        return None
    scores = [(Column(when, "L2, m", 2), f"l2_{when}_m") for when in WHENS]
    scores += [(Column(when, "collisions, %", 2), f"collision_{when}_pct") for when in WHENS]
    scores += [
        (Column(words(kind), "frames"), f"frames_{kind}") for kind in ("counted", "invalid", "without_boxes")
    ]
    sections = [
        Section(
            _planning_rows(summary, agents, [f"{protocol}.{key}" for _, key in scores]),
            PROTOCOLS[protocol].title,
        )
        for protocol in protocols
    ]
    columns = [Column(align="left"), *(column for column, _ in scores)]
    return Table(columns, sections, "Planning, open loop", [INVALID_NOTE])


def occupancy_table(summary: Summary) -> Table | None:
    """Compare IoU, precision and recall on known voxels, now and later, with the baselines."""
    whens = [match[1] for key in summary if (match := _OCCUPANCY.fullmatch(key))]
    if not whens:
        return None
    names = dict.fromkeys(match[1] for key in summary if (match := _BASELINE.fullmatch(key)))
    others = [name for name in names if name != PRIOR and "threshold" not in name]
    columns = [
        Column(align="left"),
        *(Column(title, "this model") for title in OCCUPANCY_TITLES.values()),
        *(Column(title, BASELINE_TITLES[PRIOR]) for title in OCCUPANCY_TITLES.values()),
        Column("IoU ratio to prior"),
        *(Column(BASELINE_TITLES.get(name, words(name)), "IoU of baselines") for name in others),
    ]
    sections = []
    for scope, title in SCOPE_TITLES.items():
        if f"occupancy.{scope}iou_{whens[0]}" not in summary:
            continue
        rows = []
        for when in whens:
            iou = f"occupancy.{scope}iou_{when}"
            keys = [f"occupancy.{scope}{metric}_{when}" for metric in OCCUPANCY_TITLES]
            keys += [f"{key}.{PRIOR}" for key in keys]
            ratio = ratio_to_prior(summary, iou)
            cells = [summary.get(key) for key in keys]
            cells.append(MISSING if ratio is None else f"{ratio:.2f} \N{MULTIPLICATION SIGN}")
            cells += [summary.get(f"{iou}.{name}") for name in others]
            rows.append(Row([time_title(when), *cells]))
        sections.append(Section(rows, title))
    notes = [ABOVE_NOTE, BASELINES_NOTE]
    if CEILING in others:
        notes.append(CEILING_NOTE)
    if len(sections) == len(SCOPE_TITLES):
        notes.append(MOVING_NOTE)
    # Other columns than baselines are best and mean of sampled futures
    if not set(others) <= BASELINE_TITLES.keys():
        notes.append(FUTURES_NOTE)
    return Table(columns, sections, "Occupancy on known voxels", notes)


def flow_table(summary: Summary) -> Table | None:
    """Compare flow errors on moving voxels, now and later, with the errors of predicting no motion."""
    rows = [
        (time_title(match[1]), value, summary.get(f"{key}.no_motion"))
        for key, value in summary.items()
        if (match := _FLOW.fullmatch(key))
    ]
    columns = (
        Column(align="left"),
        Column("error, m/s", digits=2),
        Column("error of predicting no motion, m/s", digits=2),
    )
    return simple_table(columns, rows, "Flow on moving voxels") if rows else None


def vehicle_table(summary: Summary) -> Table | None:
    """List the recall of grid columns that contain a car and the precision of all columns, by range."""
    rows = [
        (
            f"within {match[1]} m",
            value,
            summary.get(f"vehicles.car_columns_{match[1]}m"),
            summary.get(f"vehicles.column_precision_{match[1]}m"),
        )
        for key, value in summary.items()
        if (match := _VEHICLES.fullmatch(key))
    ]
    columns = (Column(align="left"), Column("recall"), Column("columns", digits=0), Column("precision, all"))
    return simple_table(columns, rows, "Columns of the grid that hold a car") if rows else None


def image_table(summary: Summary) -> Table | None:
    """List PSNR and SSIM of rendered images, now and later."""
    rows = []
    for prefix in (match[1] for key in summary if (match := _IMAGES.fullmatch(key))):
        when = prefix.rpartition(".")[2]
        when = time_title(when) if when.startswith("future") else "now"
        rows.append((when, summary[f"{prefix}.psnr_db"], summary.get(f"{prefix}.ssim")))
    columns = (Column(align="left"), Column("PSNR, dB", digits=2), Column("SSIM"))
    return simple_table(columns, rows, "Rendered images") if rows else None


def task_table(summary: Summary) -> Table | None:
    """Compare the main figures of metrics with their baselines and, where there are some, with ceilings."""
    from foredrive.tasks.evaluation.metrics import METRICS  # Imports PyTorch

    rows: dict[str, list[list[str]]] = {}
    # Metrics are started only to read their names and titles; their settings have no effect here
    for metric in (start(EvaluationContext(frame_dt_s=1.0)) for start in METRICS):
        for figure in metric.shown:
            key = f"{metric.name}.{figure.key}"
            if key in summary or f"{key}.{figure.baseline}" in summary:
                own, beside = (
                    number(summary.get(name), figure.digits) for name in (key, f"{key}.{figure.baseline}")
                )
                ceiling = summary.get(f"{key}.{CEILING}")
                most = "" if ceiling is None else number(ceiling, figure.digits)
                row = [figure.title, own, _baseline(figure.baseline), beside, most]
                rows.setdefault(metric.title, []).append(row)
    limited = any(row[-1] for of_metric in rows.values() for row in of_metric)
    columns = [
        Column(align="left"),
        Column("this model"),
        Column("baseline", align="left"),
        Column("its figure"),
        *([Column("ceiling of the grid")] if limited else []),
    ]
    sections = [
        Section([Row(row[: len(columns)]) for row in of_metric], title) for title, of_metric in rows.items()
    ]
    return Table(columns, sections, "Tasks at now") if sections else None


def _baseline(name: str) -> str:
    return "prior of the training logs" if name == PRIOR else words(name)


def full_table(summary: Summary) -> Table:
    """List all keys and values of summary.json."""
    return simple_table((Column("key", align="left"), Column("value", digits=5)), sorted(summary.items()))


def ratio_to_prior(summary: Summary, key: str) -> float | None:
    """Return the model's value divided by that of the occupancy prior; None if a value is missing."""
    value, prior = summary.get(key), summary.get(f"{key}.{PRIOR}")
    if not isinstance(value, float) or not isinstance(prior, float) or not prior > 0:
        return None
    return value / prior


def prior_comparison(summary: Summary, key: str) -> str:
    """Compare the model's value with that of the occupancy prior in words; nothing if a value is missing."""
    ratio, prior = ratio_to_prior(summary, key), number(summary.get(f"{key}.{PRIOR}"))
    return (
        "" if ratio is None else f"{ratio:.1f} \N{MULTIPLICATION SIGN} the {BASELINE_TITLES[PRIOR]}'s {prior}"
    )


def _planning_methods(summary: Summary) -> tuple[list[str], list[str]]:
    """Return the agents, the model first, and the protocols that have planning metrics."""
    matches = [match for key in summary if (match := _PLANNING.match(key))]
    agents = sorted({match[1] or MODEL for match in matches}, key=lambda agent: (agent != MODEL, agent))
    return agents, [name for name in PROTOCOLS if any(match[2] == name for match in matches)]


def _planning_rows(summary: Summary, agents: Sequence[str], keys: Sequence[str]) -> list[Row]:
    """Return one row for each agent; mark the best value of each score's column."""
    values = {agent: [summary.get(_planning_key(agent, key)) for key in keys] for agent in agents}
    best = [
        None if ".frames" in key else _best(column)
        for key, column in zip(keys, zip(*values.values(), strict=True), strict=True)
    ]
    return [
        Row(
            [
                AGENT_TITLES.get(agent, words(agent)),
                *(
                    Cell(value, "best" if value is not None and value == smallest else "")
                    for value, smallest in zip(values[agent], best, strict=True)
                ),
            ],
            is_strong=agent == MODEL,
        )
        for agent in agents
    ]


def _planning_key(agent: str, key: str) -> str:
    return f"planning.{agent}.{key}" if agent else f"planning.{key}"


def _best(column: Sequence[Value]) -> float | None:
    """Return the smallest value of a column; None if all values are equal or missing."""
    # A set: equal values count once
    values = {value for value in column if isinstance(value, float) and not math.isnan(value)}
    return min(values) if len(values) > 1 else None
