"""A reader of nuScenes' tables for tests: plain JSON and NumPy, by the published schema."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


class Tables:
    """The tables of a data set by token; `foreign` are the columns that name rows of other tables."""

    foreign = (
        ("scene", "log_token", "log"),
        ("scene", "first_sample_token", "sample"),
        ("scene", "last_sample_token", "sample"),
        ("sample", "scene_token", "scene"),
        ("sample_data", "sample_token", "sample"),
        ("sample_data", "ego_pose_token", "ego_pose"),
        ("sample_data", "calibrated_sensor_token", "calibrated_sensor"),
        ("calibrated_sensor", "sensor_token", "sensor"),
        ("instance", "category_token", "category"),
        ("instance", "first_annotation_token", "sample_annotation"),
        ("instance", "last_annotation_token", "sample_annotation"),
        ("sample_annotation", "sample_token", "sample"),
        ("sample_annotation", "instance_token", "instance"),
    )

    def __init__(self, root: Path, version: str = "v1.0-foredrive") -> None:
        self.root = root
        self.of = {
            file.stem: {row["token"]: row for row in json.loads(file.read_text())}
            for file in (root / version).glob("*.json")
            if file.stem != "splits"
        }

    def rows(self, table: str) -> list[Row]:
        return list(self.of[table].values())

    def chain(self, table: str, first: str) -> Iterator[Row]:
        """A row and all that follow it."""
        while first:
            row = self.of[table][first]
            yield row
            first = row["next"]

    def channel(self, reading: Row) -> str:
        sensor = self.of["calibrated_sensor"][reading["calibrated_sensor_token"]]["sensor_token"]
        return str(self.of["sensor"][sensor]["channel"])

    def readings(self, channel: str) -> list[Row]:
        found = [row for row in self.rows("sample_data") if self.channel(row) == channel]
        return sorted(found, key=lambda row: int(row["timestamp"]))

    def T_global_sensor(self, reading: Row) -> np.ndarray:
        ego = self.of["ego_pose"][reading["ego_pose_token"]]
        return matrix(ego) @ matrix(self.of["calibrated_sensor"][reading["calibrated_sensor_token"]])

    def points(self, reading: Row) -> np.ndarray:
        return np.fromfile(self.root / reading["filename"], np.float32).reshape(-1, 5)


def matrix(row: Row) -> np.ndarray:
    """Translation, and a quaternion w x y z, as a matrix."""
    w, x, y, z = row["rotation"]
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = row["translation"]
    return T
