"""Tables and a page of the figures of a task, under each of its protocols."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from foredrive.engine.summary import Summary
from foredrive.scene.map_elements import ElementKind
from foredrive.tasks.detection.protocols import DETECTION_PROTOCOLS
from foredrive.tasks.maps.protocols import PROTOCOLS
from foredrive.tasks.maps.score import FIGURES
from foredrive.tasks.occupancy.protocols import RAY_PROTOCOLS, VOXEL_PROTOCOLS
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS
from foredrive.view.html import write_page
from foredrive.view.motion_tables import motion_tables
from foredrive.view.summary_tables import full_table
from foredrive.view.table import Column, Table, simple_table, words

_DETECTION = {
    "map": Column("mAP"),
    "nds": Column("NDS"),
    "ate_m": Column("ATE, m"),
    "ase": Column("ASE"),
    "aoe_rad": Column("AOE, rad"),
    "ave_mps": Column("AVE, m/s"),
    "aae": Column("AAE"),
}
_DETECTION_CLASS = {
    "ap": Column("AP"),
    **{f"ap_{distance}m": Column(f"{distance} m", "AP") for distance in ("0.5", "1", "2", "4")},
    **{key: column for key, column in _DETECTION.items() if key not in ("map", "nds")},
}
_TRACKING = {
    "amota": Column("AMOTA"),
    "amotp_m": Column("AMOTP, m"),
    "recall": Column("recall"),
    "mota": Column("MOTA"),
    "motp_m": Column("MOTP, m"),
    "ids": Column("IDS", digits=0),
    "frag": Column("FRAG", digits=0),
    "mt": Column("MT", digits=0),
    "ml": Column("ML", digits=0),
    "fp": Column("FP", digits=0),
    "fn": Column("FN", digits=0),
    "faf_per_100_frames": Column("FAF", digits=1),
    "tid_s": Column("TID, s", digits=2),
    "lgd_s": Column("LGD, s", digits=2),
}


_KITTI_TRACKING = {
    "hota": Column("HOTA"),
    "det_a": Column("DetA"),
    "ass_a": Column("AssA"),
    "loc_a": Column("LocA"),
    "mota": Column("MOTA"),
    "motp_overlap": Column("MOTP"),
    **{key: _TRACKING[key] for key in ("recall", "ids", "frag", "mt", "ml", "fp", "fn")},
}


def detection_tables(figures: Summary) -> list[Table]:
    """Return the figures of each protocol, and those of each class under nuScenes' own."""
    if figures.get("data_set") == "kitti":
        columns = {key: c for key, c in _DETECTION_CLASS.items() if key not in ("ave_mps", "aae")}
        return [_kitti_table(figures, "detection", columns)]
    protocols = {name: protocol.title for name, protocol in DETECTION_PROTOCOLS.items()}
    classes = DETECTION_PROTOCOLS["nuscenes"].classes
    notes = _notes(figures)
    return [
        _table(figures, "detection", protocols, _DETECTION, "Detection", notes),
        _class_table(figures, "detection", classes, _DETECTION_CLASS),
    ]


def tracking_tables(figures: Summary) -> list[Table]:
    """Return the figures of each protocol, and those of each class under nuScenes' own."""
    if figures.get("data_set") == "kitti":
        return [_kitti_table(figures, "tracking", _KITTI_TRACKING)]
    protocols = {name: protocol.title for name, protocol in TRACKING_PROTOCOLS.items()}
    classes = TRACKING_PROTOCOLS["nuscenes"].classes
    return [
        _table(figures, "tracking", protocols, _TRACKING, "Tracking", _notes(figures)),
        _class_table(figures, "tracking", classes, _TRACKING),
    ]


def _table(
    figures: Summary,
    task: str,
    protocols: dict[str, str],
    columns: dict[str, Column],
    title: str,
    notes: list[str],
) -> Table:
    rows = [
        (name, *(figures.get(f"{task}.{key}.{figure}") for figure in columns))
        for key, name in protocols.items()
    ]
    table = simple_table([Column(align="left"), *columns.values()], rows, title)
    return dataclasses.replace(table, notes=notes)


def _class_table(figures: Summary, task: str, classes: tuple[str, ...], columns: dict[str, Column]) -> Table:
    prefix = f"{task}.nuscenes"
    rows = [
        (words(name), *(figures.get(f"{prefix}.{name}.{figure}") for figure in columns))
        for name in classes
        if any(key.startswith(f"{prefix}.{name}.") for key in figures)
    ]
    return simple_table([Column(align="left"), *columns.values()], rows, "Classes, nuScenes")


def _kitti_table(figures: Summary, task: str, columns: dict[str, Column]) -> Table:
    parts = [key.split(".") for key in figures if key.startswith(f"{task}.kitti.")]
    classes = dict.fromkeys(part[2] for part in parts if len(part) > 3)
    rows = [
        (words(name), *(figures.get(f"{task}.kitti.{name}.{figure}") for figure in columns))
        for name in classes
    ]
    return simple_table([Column(align="left"), *columns.values()], rows, f"{task.title()}, KITTI")


def _notes(figures: Summary) -> list[str]:
    notes = []
    if missing := figures.get("frames_without_results"):
        notes.append(f"{missing} of {figures['frames_counted']} frames are not in the results.")
    if lacks := figures.get("truth_lacks"):
        notes.append(f"The ground truth has no {lacks}: what needs it is left out, or not filtered.")
    return notes


_FIGURES = {
    "miou_pct": Column("mIoU, %", digits=2),
    "rayiou_pct": Column("mean", "RayIoU, %", digits=2),
    "rayiou_1m_pct": Column("1 m", "RayIoU, %", digits=2),
    "rayiou_2m_pct": Column("2 m", "RayIoU, %", digits=2),
    "rayiou_4m_pct": Column("4 m", "RayIoU, %", digits=2),
    "mave_mps": Column("mAVE, m/s"),
    "occ_score": Column("OccScore"),
}
_CLASS_FIGURES = {
    "iou_pct": Column("IoU, %", digits=2),
    "rayiou_pct": Column("RayIoU, %", digits=2),
    "ave_mps": Column("AVE, m/s"),
}


def occupancy_tables(figures: Summary) -> list[Table]:
    """Return the figures of each protocol, and those of each class under the data set's own protocol."""
    titles = {name: p.title for name, p in VOXEL_PROTOCOLS.items()}
    titles |= {name: p.title for name, p in RAY_PROTOCOLS.items() if name not in titles}
    rows = [
        (title, *(figures.get(f"occupancy.{name}.{key}") for key in _FIGURES))
        for name, title in titles.items()
        if any(key.startswith(f"occupancy.{name}.") for key in figures)
    ]
    data_set = str(figures["data_set"])
    by_class = [
        (words(name), *(figures.get(f"occupancy.{data_set}.{key}.{name}") for key in _CLASS_FIGURES))
        for name in VOXEL_PROTOCOLS[data_set].classes[:-1]
    ]
    first = Column(align="left")
    return [
        simple_table([first, *_FIGURES.values()], rows, "Occupancy"),
        simple_table([first, *_CLASS_FIGURES.values()], by_class, f"Classes, {titles[data_set]}"),
    ]


def map_tables(figures: Summary) -> list[Table]:
    """Return mean and class-wise average precision of each protocol that has figures."""
    classes = [kind.name.lower() for kind in ElementKind if f"map.true_{kind.name.lower()}" in figures]
    rows = []
    for name, (group, prefix) in FIGURES.items():
        keys = [f"map.{group}.{prefix}{key}" for key in ("map", *(f"ap_{name}" for name in classes))]
        if keys[0] in figures:
            rows.append((PROTOCOLS[name].title, *(figures.get(key) for key in keys)))
    columns = [Column(align="left"), Column("mAP"), *(Column(name, "AP") for name in classes)]
    return [simple_table(columns, rows, f"Map, {figures['area']} m")]


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
