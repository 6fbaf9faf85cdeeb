"""The real-to-sim gap as a table."""

from foredrive.engine.summary import Summary
from foredrive.runs.evaluate.real_to_sim_gap import AGREEMENT, REAL, RENDERED
from foredrive.tasks.occupancy.scores import ABOVE_GROUND_M
from foredrive.view.summary_tables import time_title
from foredrive.view.table import Column, Table, number, simple_table

COLUMNS = {REAL: "real", RENDERED: "rendered", AGREEMENT: "agreement of both"}
WHENS = ("now", "future_500ms", "future_1s")
SCOPES = {"": "IoU", "above_ground.": f"IoU above {ABOVE_GROUND_M:g} m"}


def gap_table(figures: Summary) -> Table:
    """Compare a model's predictions on real and on rendered images with the labels, and with each other.

    Plans are scored by UniAD's protocol.
    """
    keys = {
        f"{title}, {time_title(when)}": (f"occupancy.{scope}iou_{when}", 3)
        for scope, title in SCOPES.items()
        for when in WHENS
    }
    keys |= {f"plan L2, {when}, m": (f"planning.uniad.l2_{when}_m", 2) for when in ("1s", "2s", "3s")}
    keys["plan collisions, %"] = ("planning.uniad.collision_avg_pct", 2)
    rows = []
    for title, (key, digits) in keys.items():
        values = [figures.get(f"{column}.{key}") for column in COLUMNS]
        if any(value is not None for value in values):
            rows.append((title, *("" if value is None else number(value, digits) for value in values)))
    title = f"{figures['moments']} times; PSNR of the rendered images {number(figures['psnr_db'], 1)} dB"
    return simple_table([Column(align="left"), *map(Column, COLUMNS.values())], rows, title)
