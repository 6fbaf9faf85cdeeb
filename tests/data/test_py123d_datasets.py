"""Data sets that py123d parses: made trees of their published files convert, each through its own parser."""

import importlib.util
import io
import pickle
from pathlib import Path

import numpy as np
import pytest
import raw_kitti360
import raw_nuscenes
import raw_waymo
from test_raw_pandaset import Intruder

from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.data.raw.datasets import DATASETS
from foredrive.data.safe_pickle import PlainPickle
from foredrive.errors import InputError

HAS_NUSCENES = importlib.util.find_spec("nuscenes") is not None
HAS_TENSORFLOW = importlib.util.find_spec("tensorflow") is not None


@pytest.fixture
def kitti360(tmp_path: Path) -> Path:
    raw_kitti360.write(tmp_path / "raw")
    return tmp_path / "raw"


def test_kitti_360(kitti360: Path, tmp_path: Path) -> None:
    (path,) = convert(kitti360, "kitti360", tmp_path / "out")
    assert path.name == f"kitti360_train/{raw_kitti360.DRIVE}"
    log = Log(path)
    assert np.diff(log.T_world_ego[:, :3, 3], axis=0) == pytest.approx(np.array([[1.0, 0, 0]] * 2))
    sweep = read_sweep(log, 1)
    assert sweep is not None
    # the ego's axle is 0.05 m ahead and 0.32 m right of the IMU, and 0.9 m below it
    assert sweep[0].points_ego[0].tolist() == pytest.approx([9.95, 2.32, -0.1], abs=1e-5)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    by_x = boxes.centre[:, 0].argsort()
    assert boxes.centre[by_x, 0].tolist() == pytest.approx([9.95, 18.95], abs=1e-4)
    assert boxes.size_lwh[by_x[0]].tolist() == pytest.approx([4.0, 2.0, 1.6])
    cameras = pinhole_cameras(log)
    image = read_camera(log, 0, cameras["image_00"], (16, 32), with_image=True).image
    assert image is not None
    assert image.float().mean((1, 2)).tolist() == pytest.approx([10, 200, 30], abs=2)
    assert len(read_map_patch(log, 0).kind)
    assert not list(kitti360.rglob("*.pkl")), "the raw data set was written to"


def test_precomputed_boxes_of_kitti_360_are_not_unpickled(kitti360: Path, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    for folder in (kitti360, kitti360 / "preprocessed_detections"):
        folder.mkdir(exist_ok=True)
        file = folder / f"{raw_kitti360.DRIVE}_detection_preprocessed.pkl"
        file.write_bytes(pickle.dumps({"static": [Intruder(f"touch {ran}")]}))
    assert convert(kitti360, "kitti360", tmp_path / "out")
    assert not ran.exists()


def test_a_pickle_in_a_library_stays_plain() -> None:
    plain = PlainPickle([("collections", "OrderedDict")])
    for value in ({"a": np.arange(3.0)}, [1, "x", None]):
        assert repr(plain.loads(pickle.dumps(value))) == repr(value)
    with pytest.raises(pickle.UnpicklingError, match=r"posix\.system"):
        plain.load(io.BytesIO(pickle.dumps(Intruder("true"))))


@pytest.mark.skipif(not HAS_NUSCENES, reason="nuscenes-devkit is not installed")
def test_nuscenes_at_key_frames_and_with_sweeps(tmp_path: Path) -> None:
    raw_nuscenes.write(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "nuscenes", tmp_path / "out")
    assert path.name == f"nuscenes-mini_val/{raw_nuscenes.SCENE}"
    log = Log(path)
    assert (log.t_us - raw_nuscenes.START_US).tolist() == [0, 500_000]
    # without a CAN bus the speed is not 0: it follows from the poses
    assert log.speed_mps[1] == pytest.approx(4.0)
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([9.0, 2.0, 0.8])
    (path,) = convert(tmp_path / "raw", "nuscenes-sweeps", tmp_path / "out")
    assert path.name == f"nuscenes-interpolated-mini_val/{raw_nuscenes.SCENE}"
    log = Log(path)
    assert np.diff(log.t_us).tolist() == [100_000] * 5
    boxes = read_boxes(log, 2)
    assert boxes is not None  # 0.2 s after the key frame: 10 + 2 · 0.2 − 4 · 0.2
    assert boxes.centre[0, 0].item() == pytest.approx(9.6, abs=1e-4)
    sweep = read_sweep(log, 2)
    assert sweep is not None
    assert sweep[0].points_ego[0].tolist() == pytest.approx([6.0, 1.0, 0.8], abs=1e-5)


@pytest.mark.skipif(not HAS_NUSCENES, reason="nuscenes-devkit is not installed")
def test_a_table_cannot_name_files_outside_of_nuscenes(tmp_path: Path) -> None:
    raw_nuscenes.write(tmp_path / "raw")
    table = tmp_path / "raw" / "v1.0-mini" / "sample_data.json"
    table.write_text(table.read_text().replace("samples/CAM_FRONT/", "../secret/"))
    (tmp_path / "secret").mkdir()
    for image in (tmp_path / "raw" / "samples" / "CAM_FRONT").iterdir():
        image.rename(tmp_path / "secret" / image.name)
    with pytest.raises(InputError, match="outside of the data set"):
        convert(tmp_path / "raw", "nuscenes", tmp_path / "out")


@pytest.mark.skipif(not HAS_TENSORFLOW, reason="tensorflow is not installed")
def test_waymo_perception(tmp_path: Path) -> None:
    raw_waymo.write_perception(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "waymo", tmp_path / "out")
    assert path.name == "wod-perception_train/1_2_3"
    log = Log(path)
    assert np.diff(log.T_world_ego[:, :3, 3], axis=0) == pytest.approx(np.array([[1.0, 0, 0]]))
    sweep = read_sweep(log, 0)
    assert sweep is not None
    assert sweep[0].points_ego.norm(dim=-1).tolist() == pytest.approx([10.0] * 4, abs=0.1)
    boxes = read_boxes(log, 0)
    assert boxes is not None
    assert boxes.centre[0].tolist() == pytest.approx([10.0, 2.0, 0.8], abs=1e-4)


@pytest.mark.skipif(not HAS_TENSORFLOW, reason="tensorflow is not installed")
def test_waymo_motion(tmp_path: Path) -> None:
    raw_waymo.write_motion(tmp_path / "raw")
    (path,) = convert(tmp_path / "raw", "waymo-motion", tmp_path / "out")
    assert path.name == "wod-motion_val/abc"
    log = Log(path)
    assert len(log) == 3
    boxes = read_boxes(log, 1)
    assert boxes is not None
    assert len(boxes.centre) == 1


TREES = {
    "nuscenes": "v1.0-mini/scene.json",
    "nuscenes-sweeps": "v1.0-trainval/scene.json",
    "nuplan": "nuplan-v1.1/splits/mini/x.db",
    "waymo": "training/segment-1.tfrecord",
    "waymo-motion": "validation/x.tfrecord-00000-of-00150",
    "ncore": "clips/c/pai_c.json",
}


@pytest.mark.parametrize("dataset", TREES)
def test_a_missing_package_is_one_line_that_says_how_to_get_it(dataset: str, tmp_path: Path) -> None:
    installed = {"nuscenes": HAS_NUSCENES, "waymo": HAS_TENSORFLOW}
    if installed.get(dataset.partition("-")[0]):
        pytest.skip("it is installed")
    file = tmp_path / TREES[dataset]
    file.parent.mkdir(parents=True)
    file.write_text("[]")
    with pytest.raises(InputError, match=r"needs the package \w+: pip install") as told:
        convert(tmp_path, dataset, tmp_path / "out")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("dataset", DATASETS)
def test_an_empty_folder_is_told_what_was_looked_for(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"no {dataset} log here \(looked for "):
        convert(tmp_path, dataset, tmp_path / "out")
