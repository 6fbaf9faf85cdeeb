"""Tables of motion forecasts under every protocol."""

from foredrive.engine.summary import Summary
from foredrive.tasks.motion.argoverse import MOTION_NAMES
from foredrive.tasks.motion.moving import CLASSES as MOVING_CLASSES
from foredrive.tasks.motion.protocols import PROTOCOLS
from foredrive.tasks.motion.score import LIKELIEST
from foredrive.view.table import Column, Table, simple_table, words

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
_CHALLENGE_FIGURES = {
    "min_ade_m": Column("minADE, m"),
    "min_fde_m": Column("minFDE, m"),
    "miss_rate": Column("miss rate"),
    "brier_min_fde_m": Column("brier-minFDE, m"),
}
_END_TO_END_FIGURES = {"map_f": Column("mAP_F"), "ade_m": Column("ADE, m"), "fde_m": Column("FDE, m")}
_LEFT = Column(align="left")


def motion_tables(figures: Summary) -> list[Table]:
    """Return the tables for which a summary has figures, the main one first."""
    if "motion.argoverse.min_ade_m" in figures:
        return [_challenge(figures)]
    if "motion.argoverse.map_f" in figures:
        return [_end_to_end(figures)]
    rows = [
        (protocol.title, kind, *(figures.get(f"motion.{name}.{kind}.{key}") for key in _FIGURES))
        for name, protocol in PROTOCOLS.items()
        for kind in protocol.classes
        if f"motion.{name}.{kind}.epa" in figures
    ]
    tables = [simple_table([_LEFT, _LEFT, *_FIGURES.values()], rows, "Motion")]
    if "motion.moving.all.map_f" in figures:
        moving = [
            (kind, *(figures.get(f"motion.moving.{kind}.{key}") for key in _MOVING_FIGURES))
            for kind in (*MOVING_CLASSES, "all")
        ]
        tables.append(simple_table([_LEFT, *_MOVING_FIGURES.values()], moving, "Moving vehicles alone"))
    return tables


def _challenge(figures: Summary) -> Table:
    rows = []
    for k in LIKELIEST:
        end = "" if k == LIKELIEST[0] else f"_k{k}"
        values = (figures.get(f"motion.argoverse.{key}{end}") for key in _CHALLENGE_FIGURES)
        rows.append((f"K = {k}", *values))
    return simple_table([_LEFT, *_CHALLENGE_FIGURES.values()], rows, "Argoverse 2, single agents")


def _end_to_end(figures: Summary) -> Table:
    rows = [
        (
            words(name) or "all",
            *(figures.get(f"motion.argoverse.{group}{key}") for key in _END_TO_END_FIGURES),
        )
        for name, group in (("", ""), *((name, f"{name}.") for name in MOTION_NAMES))
    ]
    return simple_table([_LEFT, *_END_TO_END_FIGURES.values()], rows, "Argoverse 2, end to end")
