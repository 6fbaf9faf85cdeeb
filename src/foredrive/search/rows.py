"""Columns of an index. It has one row per moment of a log and view."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from foredrive.scene import Category

WHOLE = "all"
"""Name of the view of the whole scene. Other views have the names of cameras or sectors."""
EMBEDDINGS = ("image", "lidar", "joint")
"""Columns of unit vectors. `joint` is the normalised sum of the other two, or the available one (thesis,
Paper B)."""
SCORES = ("nll", "localisation", "classification", "false", "missed")
"""Negative log-likelihood of the true objects under a frame's detections, in nats, and its parts
(`foredrive.sets`)."""
COUNTS = {category: f"n_{category.name.lower()}" for category in Category}
"""Columns with the number of annotated objects by class, of the whole scene or of the sector that contains
their centre."""
FACTS = pa.schema(
    [
        ("key", pa.string()),  # of the moment: LOG@T_US, as in clips
        ("log", pa.string()),  # split/name
        ("folder", pa.string()),
        ("maps_dir", pa.string()),
        ("frame", pa.int32()),
        ("t_us", pa.int64()),  # in the time of the log
        ("t_s", pa.float64()),  # since the log's start
        ("view", pa.string()),
        # Azimuth of the sector's middle, counter-clockwise from ahead; null for the whole scene
        ("azimuth_deg", pa.float32()),
        ("dataset", pa.string()),
        ("place", pa.string()),  # town or city
        ("ego_speed", pa.float32()),  # m/s
        ("time_of_day", pa.string()),
        ("weather", pa.string()),
        ("caption", pa.string()),
        *[(name, pa.int32()) for name in COUNTS.values()],
        *[(f"score_{name}", pa.float32()) for name in SCORES],
    ]
)
"""All columns except the embeddings. Values that a log does not have are null."""


def row_schema(dim: int) -> pa.Schema:
    """Return the columns of an index with embeddings of length `dim`."""
    vector = pa.list_(pa.float32(), dim)
    return pa.schema([*FACTS, *[pa.field(name, vector) for name in EMBEDDINGS]])


@dataclass(frozen=True)
class IndexRow:
    """A row of an index without its embeddings: one view of a moment. None: the log does not state it."""

    key: str
    """Key of the moment: LOG@T_US, as in clips."""
    log: str
    """Name of the log: SPLIT/NAME."""
    folder: Path
    maps_dir: Path
    frame: int
    t_us: int
    """Time of the moment on the log's clock, µs."""
    t_s: float
    """Time since the start of the log, s."""
    view: str
    azimuth_deg: float | None
    """Azimuth of the middle of the view; None for the whole scene."""
    place: str | None
    ego_speed_mps: float | None
    time_of_day: str | None
    weather: str | None
    caption: str | None
    counts: Mapping[Category, int]
    """Number of objects by class, where the log is annotated."""

    @classmethod
    def all_of(cls, rows: pa.Table) -> "list[IndexRow]":
        """Return the rows of a table that has the columns `FACTS`."""
        return [cls._of(row) for row in rows.select(FACTS.names).to_pylist()]

    @classmethod
    def _of(cls, row: Mapping[str, Any]) -> "IndexRow":
        same = ("key", "log", "frame", "t_us", "t_s", "view", "azimuth_deg", "place")
        return cls(
            **{name: row[name] for name in (*same, "time_of_day", "weather", "caption")},
            folder=Path(row["folder"]),
            maps_dir=Path(row["maps_dir"]),
            ego_speed_mps=row["ego_speed"],
            counts={kind: row[name] for kind, name in COUNTS.items() if row[name] is not None},
        )
