"""Tables of motion forecasts under every protocol."""

from foredrive.evaluation.summary import Summary
from foredrive.metrics.motion.moving import CLASSES as MOVING_CLASSES
from foredrive.metrics.motion.protocols import PROTOCOLS
from foredrive.view.table import Column, Table, simple_table

_FIGURES = {
    "min_ade_m": Column("minADE, m"),
    "min_fde_m": Column("minFDE, m"),
    "miss_rate": Column("miss rate"),
    "epa": Column("EPA"),
}
_MOVING_FIGURES = {
    "map_f": Column("mAP_f"),
    "min_ade_m": Column("minADE, m"),
    "min_fde_m": Column("minFDE, m"),
    "miss_rate": Column("miss rate"),
}


def motion_tables(figures: Summary) -> list[Table]:
    """Return the figures of each protocol by class, and those of moving vehicles alone."""
    rows = [
        (protocol.title, kind, *(figures.get(f"motion.{name}.{kind}.{key}") for key in _FIGURES))
        for name, protocol in PROTOCOLS.items()
        for kind in protocol.classes
        if f"motion.{name}.{kind}.epa" in figures
    ]
    left = Column(align="left")
    tables = [simple_table([left, left, *_FIGURES.values()], rows, "Motion")]
    if "motion.moving.all.map_f" in figures:
        moving = [
            (kind, *(figures.get(f"motion.moving.{kind}.{key}") for key in _MOVING_FIGURES))
            for kind in (*MOVING_CLASSES, "all")
        ]
        tables.append(simple_table([left, *_MOVING_FIGURES.values()], moving, "Moving vehicles alone"))
    return tables
