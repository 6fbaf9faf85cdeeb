"""Real logs in nuScenes' format: PandaSet there and back, and Argoverse 2 on its map."""

from pathlib import Path

import numpy as np
import pytest
from nuscenes_files import Tables, matrix
from PIL import Image

from foredrive.cli.main import main
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log

pytestmark = pytest.mark.real


@pytest.mark.slow
def test_pandaset_there_and_back(real_data: Path, tmp_path: Path) -> None:
    (source,) = convert(real_data / "pandaset", "pandaset", tmp_path / "data")
    out = tmp_path / "out"
    assert (
        main(["export", "nuscenes", str(source.folder), "--out", str(out), "--rate", "1", "--no-sweeps"]) == 0
    )
    first, back = Log(source), Log(convert(out, "nuscenes", tmp_path / "back")[0])
    tables = Tables(out)
    assert len(back) == 6
    counts = []
    for at, frame in enumerate(np.searchsorted(first.t_us, back.t_us).tolist()):
        np.testing.assert_allclose(back.T_world_ego[at], first.T_world_ego[frame], atol=1e-9)
        one, other = read_boxes(first, frame), read_boxes(back, at)
        assert one is not None
        assert other is not None
        for name in ("centre", "size_lwh", "yaw"):
            np.testing.assert_allclose(getattr(other, name), getattr(one, name), atol=1e-5, err_msg=name)
        for name in ("category", "attribute", "visibility"):
            assert getattr(other, name).tolist() == getattr(one, name).tolist(), name
        before, after = read_sweep(first, frame), read_sweep(back, at)
        assert before is not None
        assert after is not None
        np.testing.assert_allclose(after[0].points_ego, before[0].points_ego, atol=1e-4)
        theirs = {camera.camera_id: camera for camera in pinhole_cameras(back).values()}
        for camera in pinhole_cameras(first).values():
            size_hw, same = (camera.height, camera.width), theirs[camera.camera_id]
            assert encoded_image(back, at, same) == encoded_image(first, frame, camera)
            two = [
                read_camera(*where, size_hw, with_image=False)
                for where in ((first, frame, camera), (back, at, same))
            ]
            np.testing.assert_allclose(two[1].T_ego_cam, two[0].T_ego_cam, atol=1e-6)
            assert two[1].exposed_dt_s == pytest.approx(two[0].exposed_dt_s, abs=2e-6)
        counts += _counts(tables, back.t_us[at])
    stated, inside = np.array(counts).T
    assert stated.sum() > 50_000
    assert np.abs(stated - inside).max() <= 1, "points on the border are rounded"


def _counts(tables: Tables, t_us: int) -> list[tuple[int, int]]:
    """The stated number of points in each box of a sample, and the number in the file."""
    (sweep,) = [row for row in tables.readings("LIDAR_TOP") if row["timestamp"] == t_us]
    T = tables.T_global_sensor(sweep)
    points = tables.points(sweep)[:, :3] @ T[:3, :3].T + T[:3, 3]
    found = []
    for box in tables.rows("sample_annotation"):
        if box["sample_token"] == sweep["sample_token"]:
            width, length, height = box["size"]
            own = (points - box["translation"]) @ matrix(box)[:3, :3]
            inside = (np.abs(own) <= np.array([length, width, height]) / 2).all(-1).sum()
            found.append((int(box["num_lidar_pts"]), int(inside)))
    return found


def test_argoverse_on_its_map(real_data: Path, tmp_path: Path) -> None:
    """The road under the vehicle is drivable; that beside the street is not."""
    log = next(
        path
        for path in convert(real_data / "av2", "av2", tmp_path / "data")
        if path.folder.name.startswith("7fab")
    )
    assert main(["export", "nuscenes", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    tables = Tables(tmp_path / "out")
    (plan,), (drive,) = tables.rows("map"), tables.rows("log")
    mask = np.asarray(Image.open(tables.root / plan["filename"]))
    driven = Log(log).T_world_ego[:, :2, 3] - drive["world_offset_m"]
    columns, rows = (driven / 0.1).round().astype(int).T
    assert (mask[len(mask) - rows, columns] == 255).all()
    assert 0.05 < (mask == 255).mean() < 0.6
