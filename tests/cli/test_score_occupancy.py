"""`foredrive score --task occupancy`: the files it writes, and flags that do not go together."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from tasks.folders_of_voxels import (
    OCC3D_FREE,
    XYZ,
    street,
    write_infos,
    write_result,
    write_truth,
)

from foredrive.cli.main import main
from foredrive.cli.score import Task
from foredrive.runs.score.tasks import TASKS
from foredrive.view.task_report import TABLES


@pytest.fixture
def folders(tmp_path: Path) -> list[str]:
    true, seen = street(OCC3D_FREE, 11, 15), np.ones(XYZ, np.uint8)
    write_truth(tmp_path / "gts", "scene-0001", "<frame>", semantics=true, mask_camera=seen, mask_lidar=seen)
    write_result(tmp_path / "results", "<frame>", pred=true)
    return [str(tmp_path / "results"), "--truth", str(tmp_path / "gts"), "--out", str(tmp_path / "out")]


def test_a_summary_a_table_and_a_page(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = write_infos(tmp_path / "infos.pkl", {"<frame>": 0.0})
    assert main(["score", *folders, "--task", "occupancy", "--poses", str(poses)]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["task"] == "occupancy"
    assert summary["frames"] == 1
    assert summary["occupancy.occ3d.miou_pct"] == summary["occupancy.occ3d.rayiou_pct"] == 100.0
    assert summary["occupancy.occ3d.iou_pct.car"] is None  # there is none
    shown = capsys.readouterr().out
    assert "Occ3D, camera and lidar mask" in shown
    assert "100.00" in shown
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("<table") == 3  # protocols, classes, all figures
    assert "driveable surface" in page


@pytest.mark.parametrize(
    ("turned", "words"),
    [
        (lambda labels: labels.swapaxes(0, 1), "x and y swapped"),
        (lambda labels: labels[::-1], "x reversed"),
        (lambda labels: labels[::-1, ::-1].swapaxes(0, 1), "x and y swapped, then x and y reversed"),
        (lambda labels: labels, None),
    ],
)
def test_voxels_with_other_axes_are_told(
    turned: Callable[[np.ndarray], np.ndarray],
    words: str | None,
    folders: list[str],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A scene that looks different along each axis: a wall ahead, and a block on its left."""
    true, seen = street(OCC3D_FREE, 11, 15), np.ones(XYZ, np.uint8)
    true[:, :, :2] = OCC3D_FREE
    true[20:60, 150:160, 2:10] = 16
    write_truth(tmp_path / "other", "scene-0001", "f", semantics=true, mask_camera=seen, mask_lidar=seen)
    results = write_result(tmp_path / "turned", "f", pred=turned(true)).parent
    flags = ["--truth", str(tmp_path / "other"), "--out", str(tmp_path / "out"), "--task", "occupancy"]
    assert main(["score", str(results), *flags]) == 0
    told = [line for line in caplog.messages if "axes" in line]
    assert len(told) == (0 if words is None else 1)
    if words is not None:
        assert f"{results}: its axes seem to be others: with {words}, the share of equal occupied" in told[0]
        assert "would be 100 % instead of" in told[0]


def test_every_task_has_its_function_and_its_tables() -> None:
    assert set(get_args(Task)) - {"sets"} == set(TASKS) == set(TABLES)


def test_wrong_folders_and_flags_are_one_line(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*flags: str) -> str:
        assert main(["score", *folders, *flags]) == 2
        return capsys.readouterr().err

    assert said("--task", "occupancy", "--poses", str(tmp_path / "none.pkl")).endswith(
        "none.pkl: No such file or directory\n"
    )
    assert "--against compares sets" in said("--task", "occupancy", "--against", str(tmp_path))
    assert "--poses does not go with --task sets" in said("--poses", str(tmp_path))
    write_result(tmp_path / "results", "<frame>", pred=np.full(XYZ, 200, np.uint8))
    error = said("--task", "occupancy")
    assert error.count("\n") == 1
    assert "<frame>.npz: pred: unknown class 200; there are 0 to 17" in error
