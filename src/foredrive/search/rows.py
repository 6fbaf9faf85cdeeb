"""The columns of an index: one row for each moment of a log and each view of it."""

import pyarrow as pa

from foredrive.scene import Category

WHOLE = "all"
"""The view that takes all sectors of a moment together; the others have the names of cameras or sectors."""
EMBEDDINGS = ("image", "lidar", "joint")
"""Unit vectors; `joint` is the normalised sum of the other two, or the one there is (thesis, Paper B)."""
SCORES = ("nll", "localisation", "classification", "false", "missed")
"""How likely a frame's detections made the truth, in nats, and its parts (`foredrive.sets`)."""
COUNTS = {category: f"n_{category.name.lower()}" for category in Category}
"""Annotated objects by class: of the whole scene, or of those whose centre lies in the sector."""
FACTS = pa.schema(
    [
        ("key", pa.string()),  # of the moment: LOG@T_US, as clips have it
        ("log", pa.string()),  # split/name
        ("folder", pa.string()),
        ("maps_dir", pa.string()),
        ("frame", pa.int32()),
        ("t_us", pa.int64()),  # in the time of the log
        ("t_s", pa.float64()),  # since the log's start
        ("view", pa.string()),
        ("azimuth_deg", pa.float32()),  # of the sector's middle, from ahead to the left; null of the whole
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
"""All but the embeddings. What a log does not tell is null."""


def row_schema(dim: int) -> pa.Schema:
    """The columns of an index whose embeddings have `dim` numbers."""
    vector = pa.list_(pa.float32(), dim)
    return pa.schema([*FACTS, *[pa.field(name, vector) for name in EMBEDDINGS]])
