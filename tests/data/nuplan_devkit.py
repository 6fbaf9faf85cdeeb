"""Stand-ins of what py123d's parser uses of nuplan-devkit: queries of one data base, by its schema."""

import contextlib
import importlib.util
import sqlite3
import sys
from collections.abc import Iterator
from enum import Enum
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace
from typing import Any

_PREFIXES = ("nuplan", "py123d.parser.nuplan")


class Translation(list[float]):
    """A list with a name of its own, as in the pickles of the data base."""


class Rotation(list[float]):
    """The same."""


class CameraIntrinsic(list[list[float]]):
    """The same."""


class CameraChannel(Enum):
    CAM_F0, CAM_B0, CAM_L0, CAM_L1, CAM_L2, CAM_R0, CAM_R1, CAM_R2 = (
        f"CAM_{place}" for place in ("F0", "B0", "L0", "L1", "L2", "R0", "R1", "R2")
    )


def execute_many(query: str, parameters: Any, file: str) -> Iterator[sqlite3.Row]:
    base = sqlite3.connect(file)
    base.row_factory = sqlite3.Row
    try:
        yield from base.execute(query, parameters)
    finally:
        base.close()


def execute_one(query: str, parameters: Any, file: str) -> sqlite3.Row | None:
    return next(iter(list(execute_many(query, parameters, file))), None)


def get_cameras(log_file: str, channels: list[str]) -> Iterator[Any]:
    for row in execute_many("SELECT * FROM camera", (), log_file):
        if row["channel"] in channels:
            yield SimpleNamespace(**dict(row))


def get_images_from_lidar_tokens(log_file: str, tokens: list[str], channels: list[str]) -> Iterator[Any]:
    """Images within 50 ms of the sweeps."""
    query = """SELECT i.*, c.channel FROM image i JOIN camera c ON c.token = i.camera_token
        JOIN lidar_pc l ON abs(i.timestamp - l.timestamp) <= 50000 WHERE l.token = ?"""
    for token in tokens:
        for row in execute_many(query, (bytes.fromhex(token),), log_file):
            if row["channel"] in channels:
                yield SimpleNamespace(**dict(row))


class _Table:
    """The rows of a table, as objects with the rows that they refer to."""

    def __init__(self, file: str, name: str, **referred: str) -> None:
        self._rows = [self._row(row) for row in execute_many(f"SELECT * FROM {name}", (), file)]
        for column, table in referred.items():
            others = {other.token: other for other in _Table(file, table)}
            for row in self._rows:
                setattr(row, column, others[getattr(row, f"{column}_token")])

    @staticmethod
    def _row(row: sqlite3.Row) -> Any:
        names = {name for name in row.keys() if name.endswith("token") and row[name] is not None}  # noqa: SIM118
        return SimpleNamespace(**{k: row[k].hex() if k in names else row[k] for k in row.keys()})  # noqa: SIM118

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> Any:
        return self._rows[index]

    def select_many(self, **values: Any) -> list[Any]:
        return [row for row in self._rows if all(getattr(row, k) == value for k, value in values.items())]


class NuPlanDB:
    def __init__(self, data_root: str, load_path: str, maps_db: None) -> None:
        self.log = _Table(load_path, "log")[0]
        self.log_name = self.log.logfile
        self.lidar_pc = _Table(load_path, "lidar_pc", ego_pose="ego_pose", scene="scene")
        self.traffic_light_status = _Table(load_path, "traffic_light_status")

    def detach_tables(self) -> None: ...

    def remove_ref(self) -> None: ...


_MODULES = {
    "nuplan.database.common.data_types": (Translation, Rotation, CameraIntrinsic),
    "nuplan.database.common.sql_types": (),
    "nuplan.database.nuplan_db.nuplan_scenario_queries": (get_cameras, get_images_from_lidar_tokens),
    "nuplan.database.nuplan_db.query_session": (execute_many, execute_one),
    "nuplan.database.nuplan_db_orm.lidar_pc": (type("LidarPc", (), {}),),
    "nuplan.database.nuplan_db_orm.nuplandb": (NuPlanDB,),
    "nuplan.planning.simulation.observation.observation_type": (CameraChannel,),
}


@contextlib.contextmanager
def devkit() -> Iterator[None]:
    """Use the devkit if it is installed; else these, which leave at the end with all that imported them."""
    if importlib.util.find_spec("nuplan") is not None:
        yield
        return
    for name, contents in _MODULES.items():
        parts = name.split(".")
        for depth in range(1, len(parts) + 1):
            whole = ".".join(parts[:depth])
            module = sys.modules.setdefault(whole, ModuleType(whole))
            module.__spec__ = ModuleSpec(whole, None)
        for one in contents:
            one.__module__ = name
            setattr(sys.modules[name], one.__name__, one)
    try:
        yield
    finally:
        for name in [name for name in sys.modules if name.startswith(_PREFIXES)]:
            del sys.modules[name]
