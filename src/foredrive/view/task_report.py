"""Tables and a page of the figures of a task, under each of its protocols."""

from collections.abc import Callable, Sequence
from pathlib import Path

from foredrive.evaluation.summary import Summary
from foredrive.metrics.voxels.protocols import (
    FREE,
    OCC3D_CLASSES,
    OPENOCC_CLASSES,
    RAY_PROTOCOLS,
    VOXEL_PROTOCOLS,
)
from foredrive.view.html import write_page
from foredrive.view.map_tables import map_tables
from foredrive.view.motion_tables import motion_tables
from foredrive.view.object_tables import detection_tables, tracking_tables
from foredrive.view.summary_tables import full_table
from foredrive.view.table import Column, Table, simple_table, words

_OCCUPANCY_FIGURES = {
    "miou_pct": Column("mIoU, %", digits=2),
    "rayiou_pct": Column("mean", "RayIoU, %", digits=2),
    "rayiou_1m_pct": Column("1 m", "RayIoU, %", digits=2),
    "rayiou_2m_pct": Column("2 m", "RayIoU, %", digits=2),
    "rayiou_4m_pct": Column("4 m", "RayIoU, %", digits=2),
    "mave_mps": Column("mAVE, m/s"),
    "occ_score": Column("OccScore"),
}
_OCCUPANCY_CLASS_FIGURES = {
    "iou_pct": Column("IoU, %", digits=2),
    "rayiou_pct": Column("RayIoU, %", digits=2),
    "ave_mps": Column("AVE, m/s"),
}


def occupancy_tables(figures: Summary) -> list[Table]:
    """Return the figures of each protocol, and those of each class under the data set's own protocol."""
    titles = {name: p.title for name, p in VOXEL_PROTOCOLS.items()}
    titles |= {name: p.title for name, p in RAY_PROTOCOLS.items() if name not in titles}
    rows = [
        (title, *(figures.get(f"occupancy.{name}.{key}") for key in _OCCUPANCY_FIGURES))
        for name, title in titles.items()
        if any(key.startswith(f"occupancy.{name}.") for key in figures)
    ]
    data_set = str(figures["data_set"])
    classes = OCC3D_CLASSES if data_set == "occ3d" else OPENOCC_CLASSES
    by_class = [
        (
            words(name),
            *(figures.get(f"occupancy.{data_set}.{key}.{name}") for key in _OCCUPANCY_CLASS_FIGURES),
        )
        for name in classes
        if name != FREE
    ]
    first = Column(align="left")
    return [
        simple_table([first, *_OCCUPANCY_FIGURES.values()], rows, "Occupancy"),
        simple_table([first, *_OCCUPANCY_CLASS_FIGURES.values()], by_class, f"Classes, {titles[data_set]}"),
    ]


TABLES: dict[str, Callable[[Summary], Sequence[Table]]] = {
    "detection": detection_tables,
    "map": map_tables,
    "motion": motion_tables,
    "occupancy": occupancy_tables,
    "tracking": tracking_tables,
}
"""Tables of a summary, the main one first, by task."""


def task_tables(figures: Summary) -> Sequence[Table]:
    """Return the tables of the task that a summary states."""
    return TABLES[str(figures["task"])](figures)


def write_task_report(path: Path, title: str, figures: Summary) -> None:
    """Write a page with the tables and all figures."""
    page = "task_report.html.j2"
    write_page(path, page, title=title, tables=task_tables(figures), all_metrics=full_table(figures))
