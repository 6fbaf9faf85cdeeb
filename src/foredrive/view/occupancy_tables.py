"""Tables of the figures of occupancy, under each of its protocols."""

from foredrive.evaluation.summary import Summary
from foredrive.metrics.voxels.protocols import RAY_PROTOCOLS, VOXEL_PROTOCOLS
from foredrive.view.table import Column, Table, simple_table, words

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
