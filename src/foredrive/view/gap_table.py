"""The real-to-sim gap as a table for the terminal."""

from collections.abc import Mapping

from rich import box
from rich.table import Table

from foredrive.metrics.occupancy import ABOVE_GROUND_M
from foredrive.runs.evaluate.real_to_sim_gap import AGREEMENT, REAL, RENDERED
from foredrive.view.summary_tables import number, when_title

COLUMNS = {REAL: "real", RENDERED: "rendered", AGREEMENT: "rendered beside real"}
WHENS = ("now", "future_500ms", "future_1s")
SCOPES = {"": "IoU", "above_ground.": f"IoU above {ABOVE_GROUND_M:g} m"}


def gap_table(figures: Mapping[str, float | int | str]) -> Table:
    """How well occupancy and plans fit the truth, and how well what comes of rendered images fits what comes
    of real ones; UniAD's protocol for plans.
    """
    title = f"{figures['moments']} moments, rendered images {number(figures['psnr_db'], 1)} dB"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for name in COLUMNS.values():
        table.add_column(name, justify="right")
    rows = {
        f"{words}, {when_title(when)}": (f"occupancy.{scope}iou_{when}", 3)
        for scope, words in SCOPES.items()
        for when in WHENS
    }
    rows |= {f"plan off by, {when} (m)": (f"planning.uniad.l2_{when}_m", 2) for when in ("1s", "2s", "3s")}
    rows["plan collides (%)"] = ("planning.uniad.collision_avg_pct", 2)
    for words, (key, digits) in rows.items():
        values = [figures.get(f"{column}.{key}") for column in COLUMNS]
        if any(value is not None for value in values):
            cells = ["" if value is None else number(value, digits) for value in values]
            table.add_row(words, *cells)
    return table
