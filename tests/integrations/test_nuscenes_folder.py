"""The folder of a data set in nuScenes' format: it grows log by log, and bad input is one line."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic_log
from end_to_end.test_full_disk import FULL, all_files, files_up_to
from miniature import write_log
from nuscenes_files import Tables

from foredrive.cli.main import main
from foredrive.data import CameraSpec, LogPath
from foredrive.data import write_log as write_own_log
from foredrive.data.clip_list import ListedClip, clip_list, write_clip_list
from foredrive.integrations.nuscenes.dataset import NuScenesFolder, export_log
from foredrive.integrations.nuscenes.scene import SceneOptions
from foredrive.runs.nuscenes import export_nuscenes

Export = Callable[..., tuple[int, str, str]]


@pytest.fixture
def export(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Export:
    """Exports into `out`; the exit code and what was said."""

    def run(*args: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main(["export", "nuscenes", *map(str, args), "--out", str(tmp_path / "out"), "--workers", "1"])
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[LogPath]:
    root = tmp_path_factory.mktemp("logs")
    return [write_log(root / name, name, frames=6) for name in ("a", "b")]


def names(out: Path, version: str = "v1.0-foredrive") -> list[str]:
    return [row["name"] for row in Tables(out, version).rows("scene")]


def test_logs_are_added_and_kept(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    out, (a, b) = tmp_path / "out", (log.folder for log in logs)
    assert export(b)[1] == f"exported flat_train/b\nwrote {out}/v1.0-foredrive\n"
    before = (out / ".v1.0-foredrive" / "flat_train" / "b" / "scene.json").stat().st_ino
    code, said, _ = export(a, b)
    assert (code, "kept flat_train/b (was there" in said, "exported flat_train/a" in said) == (0, True, True)
    assert names(out) == ["flat_train-a", "flat_train-b"]
    assert len(Tables(out).of["sensor"]) == 3  # both logs have the same channels
    assert (out / ".v1.0-foredrive" / "flat_train" / "b" / "scene.json").stat().st_ino == before
    together = {file: (out / file).read_bytes() for file in all_files(out)}
    shutil.rmtree(out)
    export(a, b)
    assert {file: (out / file).read_bytes() for file in all_files(out)} == together
    assert export("--overwrite", b)[1].startswith("exported flat_train/b\n")


def test_several_processes_give_the_same(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    export(*(log.folder for log in logs))
    folders = [str(log.folder) for log in logs]
    assert main(["export", "nuscenes", *folders, "--out", str(tmp_path / "two"), "--workers", "2"]) == 0
    for file in all_files(tmp_path / "out"):
        assert (tmp_path / "two" / file).read_bytes() == (tmp_path / "out" / file).read_bytes(), file


def test_an_interrupted_export_goes_on(logs: list[LogPath], tmp_path: Path) -> None:
    folder = NuScenesFolder(tmp_path, "foredrive", SceneOptions())
    left = 9

    def tick() -> None:
        nonlocal left
        left -= 1
        if not left:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(export_nuscenes(logs, folder, 1, tick=tick))
    assert not folder.tables.exists()
    assert not [name for name in all_files(tmp_path) if name.endswith(".part")]
    results = list(export_nuscenes(logs, folder, 1))
    assert [result.kept for result in results] == [True, False]
    assert names(tmp_path) == ["flat_train-a", "flat_train-b"]


def test_another_data_set_is_left_alone(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    tables = tmp_path / "out" / "v1.0-mini"
    tables.mkdir(parents=True)
    (tables / "scene.json").write_text("[]")
    code, _, err = export("--name", "mini", logs[0].folder)
    assert (code, err) == (
        2,
        f"foredrive: {tables}: there is another data set already; choose another --name\n",
    )
    assert all_files(tmp_path / "out") == {"v1.0-mini/scene.json"}
    assert export(logs[0].folder)[0] == 0  # beside it
    assert (tables / "scene.json").read_text() == "[]"


def test_other_options_are_told(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    export(logs[0].folder)
    code, _, err = export(logs[1].folder, "--rate", "5", "--no-sweeps")
    begun = "was begun with --rate 2, not --rate 5 --no-sweeps; choose another --name"
    assert (code, err) == (2, f"foredrive: {tmp_path}/out/v1.0-foredrive: {begun}\n")


def test_a_damaged_log_stops_no_other(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    bad = tmp_path / "logs" / "flat_train" / "bad"
    shutil.copytree(logs[0].folder, bad)
    with (bad / "lidar.lidar_top.arrow").open("r+b") as file:
        file.truncate(2000)
    code, said, err = export(bad, logs[1].folder)
    assert code == 2
    assert "exported flat_train/b" in said
    assert err.startswith("foredrive: 1 of 2 logs failed: flat_train/bad (")
    assert err.count("\n") == 1
    assert names(tmp_path / "out") == ["flat_train-b"]


def test_a_log_without_sensors_is_one_line(export: Export, tmp_path: Path) -> None:
    log = write_own_log(tmp_path / "data", "blind", np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    code, _, err = export(log.folder)
    told = f"{log.folder}: has neither images of pinhole cameras nor lidar sweeps"
    assert (code, err) == (2, f"foredrive: {told}\n")
    assert not (tmp_path / "out" / "v1.0-foredrive").exists()


def test_sensors_that_never_agree_are_one_line(export: Export, tmp_path: Path) -> None:
    image, camera = np.zeros((8, 8, 3), np.uint8), CameraSpec("front", np.eye(3), np.eye(4), (8, 8))
    images: list[np.ndarray | None] = [image, None]
    log = write_own_log(
        tmp_path / "data", "apart", np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)),
        cameras=[camera], images={"front": images}, boxes=[None, []],
    )  # fmt: skip
    code, _, err = export(log.folder)
    told = "no frame has all sensors and boxes (frames with: CAM_FRONT 1, boxes 1)"
    assert (code, err) == (2, f"foredrive: {log.folder}: {told}\n")


@pytest.mark.parametrize("without", ["cameras", "lidar", "boxes"])
def test_a_log_may_lack_a_kind_of_data(without: str, export: Export, tmp_path: Path) -> None:
    folder = synthetic_log.write(tmp_path / "data", frames=6, specs=[] if without == "cameras" else None)
    for file in {"lidar": folder.glob("*lidar*"), "boxes": folder.glob("box*")}.get(without, ()):
        file.unlink()
    code, _, err = export(folder)
    assert (code, err) == (0, "")
    tables = Tables(tmp_path / "out")
    channels = {row["channel"] for row in tables.rows("sensor")}
    assert (
        channels
        == {
            "cameras": {"LIDAR_TOP"},
            "lidar": {"CAM_FRONT", "CAM_FRONT_LEFT"},
            "boxes": {"CAM_FRONT", "CAM_FRONT_LEFT", "LIDAR_TOP"},
        }[without]
    )
    assert len(tables.rows("sample_annotation")) == (0 if without == "boxes" else 4)
    if without == "lidar":
        assert {row["num_lidar_pts"] for row in tables.rows("sample_annotation")} == {0}


def test_flags_that_cannot_be(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    assert export(logs[0].folder, "--rate", "0")[2] == "foredrive: --rate must be a number above 0, got 0\n"
    assert "--name '../x': letters, digits" in export(logs[0].folder, "--name", "../x")[2]
    assert export()[2] == "foredrive: export nuscenes needs a log, or a data root with logs\n"
    clips, (log, _) = tmp_path / "clips.json", logs
    write_clip_list(clips, clip_list([ListedClip(log.folder, log.maps_dir, 0.0, 0.3)]))
    assert "whole logs are exported, not parts of them as of flat_train/a" in export(clips)[2]
    assert not (tmp_path / "out" / "v1.0-foredrive").exists()


def test_a_full_disk_is_one_line(logs: list[LogPath], export: Export, tmp_path: Path) -> None:
    with files_up_to(1000):  # images are larger
        code, _, err = export(logs[0].folder)
    assert code == 2
    assert err.startswith(f"foredrive: {tmp_path}/out/")
    assert err.endswith(f": {FULL}\n")
    assert err.count("\n") == 1
    assert not any(name.endswith(".jpg") or "/v1.0" in f"/{name}" for name in all_files(tmp_path / "out"))
    assert export(logs[0].folder)[0] == 0


def test_one_log_without_its_tables(logs: list[LogPath], tmp_path: Path) -> None:
    folder = NuScenesFolder(tmp_path, "foredrive", SceneOptions())
    frames = []
    export_log(logs[0], folder, lambda: frames.append(1))
    assert len(frames) == 6
    assert not folder.tables.exists()
