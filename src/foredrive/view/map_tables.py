"""Tables of vector maps under every protocol."""

from foredrive.evaluation.maps.score import FIGURES
from foredrive.evaluation.summary import Summary
from foredrive.metrics.maps.protocols import PROTOCOLS
from foredrive.scene.map_elements import ElementKind
from foredrive.view.table import Column, Table, simple_table


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
