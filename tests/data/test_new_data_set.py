"""A data set is added as CONTRIBUTING says: a parser in a file of its own, and a line in `DATASETS`."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from py123d.datatypes import EgoStateSE3, LogMetadata, Timestamp
from py123d.geometry import PoseSE3
from py123d.parser.base_dataset_parser import BaseLogParser, ModalitiesSync
from py123d.parser.nuscenes.utils.nuscenes_constants import NUSCENES_EGO_STATE_SE3_METADATA

from foredrive.cli.main import main
from foredrive.data import find_logs
from foredrive.data.formats.convert import DATASETS, RawDataset
from foredrive.data.formats.raw_log import RawLog, folders_with
from foredrive.data.logs import Log


@dataclass(frozen=True)
class PathParser(BaseLogParser):
    """Parser of a file with a line for each frame: time (s), x and y (m)."""

    file: Path

    def get_log_metadata(self) -> LogMetadata:
        """Return split and name of the log."""
        return LogMetadata("paths", "paths_train", self.file.parent.name, location=None)

    def iter_modalities_sync(self) -> Iterator[ModalitiesSync]:
        """Yield the vehicle at each time."""
        for t_s, x, y in np.loadtxt(self.file, ndmin=2).tolist():
            pose, t = PoseSE3(x, y, 0.0, 1.0, 0.0, 0.0, 0.0), Timestamp.from_us(round(t_s * 1e6))
            yield ModalitiesSync(t, [EgoStateSE3.from_imu(pose, NUSCENES_EGO_STATE_SE3_METADATA, t)])


def find_paths(source: Path) -> Iterator[RawLog]:
    """Yield the logs of a folder."""
    for folder in folders_with(source, "path.txt"):
        yield RawLog(folder, PathParser(folder / "path.txt"))


def test_its_logs_are_converted_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DATASETS, "paths", RawDataset(find_paths, "path.txt"))
    for name, x_m in (("one", 1.0), ("two", 5.0)):
        (tmp_path / "raw" / name).mkdir(parents=True)
        (tmp_path / "raw" / name / "path.txt").write_text(f"0 {x_m} 2\n0.5 {x_m + 3} 2\n")
    line = ["convert", "paths", str(tmp_path / "raw"), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(line) == 0
    logs = {path.folder.name: Log(path) for path in find_logs(tmp_path / "out")}
    assert sorted(logs) == ["one", "two"]
    assert logs["two"].T_world_ego[:, :2, 3].tolist() == [[5.0, 2.0], [8.0, 2.0]]


def test_a_folder_without_them_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(DATASETS, "paths", RawDataset(find_paths, "path.txt"))
    assert main(["convert", "paths", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no paths log here (looked for path.txt)" in capsys.readouterr().err
