"""MCAP files of logs and runs: read back with the mcap library, and by our own reader of bags."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import test_maps
import yaml
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from miniature import write_log

from foredrive.cli.main import main
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.bag_proposal import propose_topics
from foredrive.data.formats.bag_topics import topics_file
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.errors import InputError
from foredrive.scene import Category
from foredrive.view.log_frames import LogFrames
from foredrive.view.log_mcap import write_log_mcap

if TYPE_CHECKING:
    from foredrive.runs import Run

FRAMES = 6


def messages(file: Path) -> dict[str, list[tuple[int, Any]]]:
    """Time (µs) and message by topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with file.open("rb") as opened:
        for each in make_reader(opened, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            found.setdefault(each.channel.topic, []).append(
                (each.message.log_time // 1000, each.decoded_message)
            )
    return found


def test_a_log_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_log(tmp_path / "data", frames=FRAMES)
    file = tmp_path / "log.mcap"
    assert main(["export", "mcap", str(path.folder), "--out", str(file)]) == 0
    assert f"wrote {file} with /boxes, /camera/" in capsys.readouterr().out
    log, found = Log(path), messages(file)
    name, camera = next(iter(pinhole_cameras(log).items()))
    assert [t_us for t_us, _ in found["/lidar"]] == log.t_us.tolist()
    poses = [message for _, message in found["/tf"] if message.child_frame_id == "ego"]
    places = [[p.translation.x, p.translation.y, p.translation.z] for p in poses]
    np.testing.assert_allclose(places, log.T_world_ego[:, :3, 3], atol=1e-9)
    t_us, image = found[f"/camera/{name}/image"][2]
    assert image.data == encoded_image(log, 2, camera)
    assert image.timestamp.ToMicroseconds() == pytest.approx(t_us, abs=60_000)
    boxes = read_boxes(log, 2)
    assert boxes is not None
    shown = found["/boxes"][2][1]
    assert shown.deletions[0].type == 1  # all before
    assert len(shown.entities) == len(boxes.valid)
    cube = shown.entities[0].cubes[0]
    centre = [cube.pose.position.x, cube.pose.position.y, cube.pose.position.z]
    assert centre == pytest.approx(boxes.centre[0].tolist())
    assert [cube.size.x, cube.size.y, cube.size.z] == pytest.approx(boxes.size_lwh[0].tolist())
    turn = 2 * np.arctan2(cube.pose.orientation.z, cube.pose.orientation.w)
    assert np.cos(turn - float(boxes.yaw[0])) == pytest.approx(1.0)
    assert Category(int(boxes.category[0])).name.lower() in shown.entities[0].texts[0].text
    driven = found["/driven"][0][1].poses
    step = np.linalg.inv(log.T_world_ego[0]) @ log.T_world_ego[5]
    if abs(log.t_us[5] - log.t_us[0] - 500_000) < 1000:
        assert [driven[0].position.x, driven[0].position.y] == pytest.approx(step[:2, 3].tolist(), abs=1e-4)


def test_the_map_is_in_the_world_frame(tmp_path: Path) -> None:
    log = test_maps.write_with_map(tmp_path / "data")
    write_log_mcap(log.path, tmp_path / "log.mcap")
    ((_, shown),) = messages(tmp_path / "log.mcap")["/map"]
    (entity,) = shown.entities
    assert entity.frame_id == "world"
    patch = read_map_patch(log, 0)
    assert len(entity.lines) == len(patch.kind)
    points = np.array([[point.x, point.y, point.z] for point in entity.lines[0].points])
    T = log.T_world_ego[0]
    expected = patch.vertices[0][patch.valid[0]].double().numpy() @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(points, expected, atol=1e-3)


def test_an_exported_log_converts_back(tmp_path: Path) -> None:
    """The bag reader puts poses, points, calibration and images where they were."""
    path = write_log(tmp_path / "data", frames=FRAMES)
    file = tmp_path / "log.mcap"
    write_log_mcap(path, file)
    propose_topics(file, topics_file(file))
    written = yaml.safe_load(topics_file(file).read_text())
    assert (written["world_frame"], written["ego_frame"]) == ("world", "ego")
    assert written["lidar"]["intensity_max"] == 1.0
    written["lidar"]["compensated"] = True  # logs hold compensated points
    topics_file(file).write_text(yaml.safe_dump(written))
    first, back = Log(path), Log(convert(file, "rosbag", tmp_path / "out")[0])
    np.testing.assert_allclose(back.T_world_ego, first.T_world_ego, atol=1e-6)
    before, after = read_sweep(first, 3), read_sweep(back, 3)
    assert before is not None
    assert after is not None
    kept = before[0][before[0].returned]
    np.testing.assert_allclose(after[0].points_ego.numpy(), kept.points_ego.numpy(), atol=1e-4)
    np.testing.assert_allclose(after[0].dt_s.numpy(), kept.dt_s.numpy(), atol=2e-6)
    cameras = [next(iter(pinhole_cameras(log).values())) for log in (first, back)]
    size_hw = (cameras[0].height, cameras[0].width)
    one, other = (
        read_camera(log, 3, camera, size_hw, with_image=True)
        for log, camera in zip((first, back), cameras, strict=True)
    )
    np.testing.assert_allclose(other.K.numpy(), one.K.numpy(), atol=1e-3)
    np.testing.assert_allclose(other.T_ego_cam.numpy(), one.T_ego_cam.numpy(), atol=1e-4)
    assert one.image is not None
    assert other.image is not None
    assert (one.image.float() - other.image.float()).abs().mean() < 3


def test_plans_and_occupancy_of_a_run(trained: "Run", tmp_path: Path) -> None:
    log = trained.logs[0]
    write_log_mcap(log, tmp_path / "run.mcap", trained)
    found = messages(tmp_path / "run.mcap")
    spec = trained.recipe.clips.voxels
    _, grid = found["/occupancy"][-1]
    assert (grid.row_count, grid.column_count) == spec.shape_zyx[1:]
    assert len(grid.data) == 4 * np.prod(spec.shape_zyx)
    assert grid.cell_size.x == pytest.approx(spec.voxel_m)
    assert [grid.pose.position.x, grid.pose.position.y] == pytest.approx(spec.lower_m[:2])
    _, plan = found["/plan"][-1]
    frames = LogFrames(log, 64, trained)
    predicted = frames.prediction(len(frames) - 1)
    assert predicted is not None
    shown = [[pose.position.x, pose.position.y] for pose in plan.poses]
    np.testing.assert_allclose(shown, predicted.plan.xy[0][predicted.plan.valid[0]].numpy(), atol=1e-5)
    assert plan.frame_id == "ego"


def test_a_wrong_name_is_told(log: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.mcap"):
        write_log_mcap(log, tmp_path / "log.txt")
