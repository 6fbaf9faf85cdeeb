"""Tables of a report, read off a summary's flat dotted keys; a figure that is missing is a dash."""

import math
import re
from collections.abc import Mapping, Sequence
from html import escape

from foredrive.evaluation.summary import rivals_of_occupancy
from foredrive.metrics.occupancy import ABOVE_GROUND_M
from foredrive.metrics.protocols import HORIZON_NAMES, PROTOCOLS

Figure = float | int | str | None
Summary = Mapping[str, Figure]

MISSING = "&ndash;"
RIVALS_NOTE = (
    '<p class="note">Copy: the predicted present in place of the future. Carried copy: moved by the path '
    "that was driven, which no model knows. Best and mean of k: futures drawn by chance.</p>"
)
MODEL = ""
AGENT_TITLES = {MODEL: "this model", "ego_mlp": "MLP of ego status alone"}
PROTOCOL_TITLES = {
    "stp3": "ST-P3",
    "uniad": "UniAD",
    "vad": "VAD",
    "sparsedrive": "SparseDrive",
    "bevplanner": "BEV-Planner",
}
WHENS = (*HORIZON_NAMES, "avg")
SCOPE_TITLES = {"": "all voxels", "above_ground.": f"more than {ABOVE_GROUND_M:g} m above the ground"}
OCCUPANCY_TITLES = {"iou": "IoU", "precision": "precision", "recall": "recall"}
_PLANNING = re.compile(rf"planning\.(?:(\w+)\.)?({'|'.join(PROTOCOLS)})\.\w+")
_OCCUPANCY = re.compile(r"occupancy\.iou_(\w+)")
_FLOW = re.compile(r"flow\.epe_moving_(\w+)_mps")
_IMAGES = re.compile(r"(\w+(?:\.\w+)*)\.psnr_db")


def number(value: Figure, digits: int = 3) -> str:
    """A figure as text: that many digits after the point for floats, a dash for what is missing."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if isinstance(value, float):
        return f"{value:z.{digits}f}"
    return escape(str(value))


def when_title(name: str) -> str:
    """`future_500ms` -> +500 ms; `now` stays."""
    later = re.fullmatch(r"future_(\d+)(ms|s)", name)
    return f"+{later[1]} {later[2]}" if later else name


def planning_tables(summary: Summary) -> str:
    """Averages under all protocols side by side, then every horizon of each; the best value is marked."""
    found = [match for key in summary if (match := _PLANNING.match(key))]
    agents = sorted({match[1] or MODEL for match in found}, key=lambda agent: (agent != MODEL, agent))
    protocols = [name for name in PROTOCOLS if any(match[2] == name for match in found)]
    if not protocols:
        return ""
    averages = [(p, metric) for p in protocols for metric in ("l2_avg_m", "collision_avg_pct")]
    head = "".join(f'<th class="group" colspan="2">{PROTOCOL_TITLES.get(p, p)}</th>' for p in protocols)
    overview = (
        f'<tr><th rowspan="2"></th>{head}</tr><tr>{"<th>L2, m</th><th>coll., %</th>" * len(protocols)}</tr>'
    )
    horizons = "".join(f"<th>{when}</th>" for when in WHENS)
    detail_head = (
        '<tr><th rowspan="2"></th><th class="group" colspan="4">L2, m</th>'
        '<th class="group" colspan="4">collision, %</th><th class="group" colspan="3">frames</th></tr>'
        f"<tr>{horizons * 2}<th>counted</th><th>invalid</th><th>without boxes</th></tr>"
    )
    scores = [f"l2_{when}_m" for when in WHENS] + [f"collision_{when}_pct" for when in WHENS]
    counts = ["frames_counted", "frames_invalid", "frames_without_boxes"]
    bodies = [
        _tbody(
            _planning_rows(summary, agents, [(p, metric) for metric in scores + counts]),
            PROTOCOL_TITLES.get(p, p),
            1 + len(scores + counts),
        )
        for p in protocols
    ]
    return (
        _table(overview, _tbody(_planning_rows(summary, agents, averages)))
        + '<p class="note">Green: the best of a column. Protocols measure different things: compare '
        "within a column, never across.</p><h3>Every horizon</h3>"
        + _table(detail_head, "".join(bodies))
        + '<p class="note">Invalid frames have no complete driven future: UniAD\'s protocol counts what '
        "there is of them, the others leave them out.</p>"
    )


def occupancy_table(summary: Summary) -> str:
    """IoU, precision and recall on known voxels, now and later, beside those of the best constant."""
    whens = [match[1] for key in summary if (match := _OCCUPANCY.fullmatch(key))]
    if not whens:
        return ""
    names = "".join(f"<th>{title}</th>" for title in OCCUPANCY_TITLES.values())
    rivals = {name: title for name, title in rivals_of_occupancy(summary).items() if name != "best_constant"}
    others = "".join(f'<th rowspan="2">IoU, {title}</th>' for title in rivals.values())
    head = (
        '<tr><th rowspan="2"></th><th class="group" colspan="3">this model</th>'
        '<th class="group" colspan="3">best constant</th><th rowspan="2">IoU ratio</th>'
        f"{others}</tr><tr>{names * 2}</tr>"
    )
    bodies = []
    for scope, title in SCOPE_TITLES.items():
        rows = []
        for when in whens:
            keys = [f"occupancy.{scope}{metric}_{when}" for metric in OCCUPANCY_TITLES]
            cells = [_cell(summary.get(key)) for key in keys]
            cells += [_cell(summary.get(f"{key}.best_constant")) for key in keys]
            ratio = ratio_to_constant(summary, f"occupancy.{scope}iou_{when}")
            cells.append(f"<td>{MISSING if ratio is None else f'{ratio:.2f} &times;'}</td>")
            cells += [_cell(summary.get(f"occupancy.{scope}iou_{when}.{rival}")) for rival in rivals]
            rows.append(_row(when_title(when), cells))
        bodies.append(_tbody(rows, title, 8 + len(rivals)))
    return _table(head, "".join(bodies)) + (RIVALS_NOTE if rivals else "")


def flow_table(summary: Summary) -> str:
    """Errors of predicted flow on voxels that move, now and later, beside those of predicting none."""
    rows = []
    for key, value in summary.items():
        if found := _FLOW.fullmatch(key):
            rows.append(
                _row(when_title(found[1]), [_cell(value, 2), _cell(summary.get(f"{key}.no_motion"), 2)])
            )
    head = "<tr><th></th><th>error, m/s</th><th>predicting none, m/s</th></tr>"
    return _table(head, _tbody(rows)) if rows else ""


def image_table(summary: Summary) -> str:
    """PSNR and SSIM of rendered images, now and later."""
    prefixes = [match[1] for key in summary if (match := _IMAGES.fullmatch(key))]
    rows = []
    for prefix in prefixes:
        when = prefix.rpartition(".")[2]
        cells = [_cell(summary[f"{prefix}.psnr_db"], 2), _cell(summary.get(f"{prefix}.ssim"))]
        rows.append(_row(when_title(when) if when.startswith("future") else "now", cells))
    return _table("<tr><th></th><th>PSNR, dB</th><th>SSIM</th></tr>", _tbody(rows)) if rows else ""


def full_table(summary: Summary) -> str:
    """Every key of the summary, as it stands in summary.json."""
    rows = [
        f'<tr><td class="text"><code>{escape(key)}</code></td><td>{number(value, 5)}</td></tr>'
        for key, value in sorted(summary.items())
    ]
    return _table('<tr><th class="text">key</th><th>value</th></tr>', _tbody(rows))


def ratio_to_constant(summary: Summary, key: str) -> float | None:
    """How many times the best constant's value a model's is."""
    value, constant = summary.get(key), summary.get(f"{key}.best_constant")
    if not isinstance(value, float) or not isinstance(constant, float) or not constant > 0:
        return None
    return value / constant


def _planning_rows(summary: Summary, agents: Sequence[str], columns: Sequence[tuple[str, str]]) -> list[str]:
    """One row an agent; the best value of every score's column is marked."""
    table = {
        (agent, column): summary.get(f"planning.{f'{agent}.' if agent else ''}{column[0]}.{column[1]}")
        for agent in agents
        for column in columns
    }
    best = {}
    for column in columns:
        values = [v for agent in agents if isinstance(v := table[agent, column], float) and not math.isnan(v)]
        differ = len(set(values)) > 1 and not column[1].startswith("frames")
        best[column] = min(values) if differ else None
    rows = []
    for agent in agents:
        cells = [
            _cell(
                table[agent, column],
                digits=2,
                best=best[column] is not None and table[agent, column] == best[column],
            )
            for column in columns
        ]
        rows.append(_row(AGENT_TITLES.get(agent, agent.replace("_", " ")), cells, model=agent == MODEL))
    return rows


def _cell(value: Figure, digits: int = 3, best: bool = False) -> str:
    return f'<td class="best">{number(value, digits)}</td>' if best else f"<td>{number(value, digits)}</td>"


def _row(title: str, cells: Sequence[str], model: bool = False) -> str:
    kind = ' class="model"' if model else ""
    return f'<tr{kind}><th scope="row">{escape(title)}</th>{"".join(cells)}</tr>'


def _tbody(rows: Sequence[str], title: str = "", columns: int = 0) -> str:
    head = f'<tr><th class="text" colspan="{columns}">{escape(title)}</th></tr>' if title else ""
    return f"<tbody>{head}{''.join(rows)}</tbody>"


def _table(head: str, bodies: str) -> str:
    return f'<div class="scroll"><table><thead>{head}</thead>{bodies}</table></div>'
