"""NCore v4: logs that come back from it, read by its own library too, and sequences that others wrote."""

import importlib.util
import io
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import torch
import zarr
from miniature import write_log
from ncore.data import (
    BBox3,
    CameraModelParameters,
    CuboidTrackObservation,
    FThetaCameraModelParameters,
    LabelSource,
    OpenCVFisheyeCameraModelParameters,
    ShutterType,
)
from ncore.data.v4 import (
    CameraSensorComponent,
    CuboidsComponent,
    IntrinsicsComponent,
    LidarSensorComponent,
    MasksComponent,
    PosesComponent,
    SequenceComponentGroupsReader,
    SequenceComponentGroupsWriter,
    SequenceLoaderV4,
)
from ncore.impl.common.transformations import HalfClosedInterval, transform_bbox
from ncore.impl.data.stores import consolidate_compressed_metadata
from PIL import Image
from scipy.spatial.transform import Rotation
from test_own_logs import CAMERA, SIZE_HW, pose_at
from upath import UPath

from foredrive.cli.main import main
from foredrive.data import LogPath, Points
from foredrive.data import write_log as write_own_log
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import encoded_image, pinhole_cameras, read_camera
from foredrive.data.formats.convert import convert
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.data.notices import read_notices
from foredrive.errors import InputError
from foredrive.scene import Category

FRAMES = 11
SWEEP_US = 100_000
START_US = 100_000_000


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("log"), frames=FRAMES)


@pytest.fixture(scope="module")
def exported(source: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("ncore")
    assert main(["export", "ncore", str(source.folder), "--out", str(out)]) == 0
    return out


def sorted_beams(log: Log, frame: int) -> Any:
    read = read_sweep(log, frame)
    assert read is not None
    assert read[1]  # with the beams that did not return
    sweep = read[0]
    degrees = torch.rad2deg(torch.atan2(sweep.dir_ego[:, 1], sweep.dir_ego[:, 0])).round() % 360
    return sweep[np.lexsort([degrees, sweep.beam])]


def test_a_log_comes_back(source: LogPath, exported: Path, tmp_path: Path) -> None:
    (path,) = convert(exported, "ncore", tmp_path)
    assert not [notice for notice in read_notices(path.folder) if "assumed" in notice]
    before, after = Log(source), Log(path)
    np.testing.assert_array_equal(after.t_us, before.t_us)
    np.testing.assert_allclose(after.T_world_ego, before.T_world_ego, atol=1e-9)
    for mine, theirs in zip(after.ego_box, before.ego_box, strict=True):
        np.testing.assert_allclose(mine, theirs)
    assert after.vehicle.wheel_base == before.vehicle.wheel_base
    cameras, had = pinhole_cameras(after), pinhole_cameras(before)
    assert cameras.keys() == had.keys()
    for frame in (0, FRAMES - 1):
        for name, camera in cameras.items():
            assert encoded_image(after, frame, camera) == encoded_image(before, frame, had[name])
            mine, theirs = (
                read_camera(log, frame, one, (one.height, one.width), with_image=False)
                for log, one in ((after, camera), (before, had[name]))
            )
            torch.testing.assert_close(mine.K, theirs.K)
            torch.testing.assert_close(mine.T_ego_cam, theirs.T_ego_cam)
        sweep, swept = sorted_beams(after, frame), sorted_beams(before, frame)
        assert 0 < (~swept.returned).sum() < len(swept.returned)
        for part in ("points_ego", "range_m", "intensity", "beam", "returned", "dt_s"):
            torch.testing.assert_close(getattr(sweep, part), getattr(swept, part), rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(sweep.dir_ego, swept.dir_ego, rtol=0, atol=1e-4)
        boxes, boxed = read_boxes(after, frame), read_boxes(before, frame)
        assert boxes is not None
        assert boxed is not None
        for part in ("centre", "size_lwh", "yaw", "velocity", "track_id", "category"):
            torch.testing.assert_close(getattr(boxes, part), getattr(boxed, part), rtol=1e-4, atol=1e-3)


def test_its_own_library_reads_what_was_written(tmp_path: Path) -> None:
    """A turning car with a rolling shutter and uncompensated points, and static things around it."""
    things = np.array([[40.0, -4.0, 2.0], [28.0, 3.0, 1.0], [35.0, 5.0, 3.0]])
    t_s = START_US * 1e-6 + 0.1 * np.arange(4)
    dt_s = np.array([-0.05, 0.0, 0.04])
    sweeps = []
    for now in t_s:
        seen = [
            np.linalg.inv(pose_at(now + dt)) @ [*thing, 1.0] for dt, thing in zip(dt_s, things, strict=True)
        ]
        sweeps.append(Points(np.stack(seen)[:, :3], dt_s=dt_s, compensated=False))
    dense_s = np.arange(t_s[0] - 0.2, t_s[-1] + 0.2, 0.01)
    camera = type(CAMERA)("front", CAMERA.K, CAMERA.T_ego_cam, SIZE_HW, 0.02, np.array([0.1, 0, 0.01, 0, 0]))
    log = write_own_log(
        tmp_path / "data",
        "turning",
        t_s,
        np.stack([pose_at(now) for now in t_s]),
        cameras=[camera],
        images={"front": [np.zeros((*SIZE_HW, 3), np.uint8)] * 4},
        image_t_s={"front": t_s + 0.03},
        sweeps=sweeps,
        lidar_position_m=(1.0, 0.2, 1.8),
        path=(dense_s, np.stack([pose_at(now) for now in dense_s])),
    )
    assert main(["export", "ncore", str(log.folder), "--out", str(tmp_path / "out")]) == 0
    (summary,) = (tmp_path / "out").rglob("*.json")
    sequence = SequenceLoaderV4(SequenceComponentGroupsReader([summary]))
    (lidar_id,) = sequence.lidar_ids
    lidar, graph = sequence.get_lidar_sensor(lidar_id), sequence.pose_graph
    for row in range(4):
        cloud = lidar.get_frame_point_cloud(row, motion_compensation=True, with_start_points=True)
        T = graph.evaluate_poses(lidar_id, "world", lidar.frames_timestamps_us[row, 1:])[0]
        np.testing.assert_allclose(cloud.xyz_m_end @ T[:3, :3].T + T[:3, 3], things, atol=0.01)
    sensor = sequence.get_camera_sensor("front")
    assert sensor.model_parameters.shutter_type == ShutterType.ROLLING_TOP_TO_BOTTOM
    # The middle row of the first image is exposed 0.03 s after the frame
    np.testing.assert_array_equal(sensor.frames_timestamps_us[0], START_US + np.array([20_000, 40_000]))
    T = graph.evaluate_poses("front", "world", np.array([START_US + 30_000], np.uint64))[0]
    np.testing.assert_allclose(T, pose_at(100.03) @ CAMERA.T_ego_cam, atol=0.01)
    np.testing.assert_allclose(sensor.model_parameters.radial_coeffs[:2], [0.1, 0.0])
    np.testing.assert_allclose(sensor.model_parameters.tangential_coeffs, [0.01, 0.0])


FISHEYE = OpenCVFisheyeCameraModelParameters(
    resolution=np.array([160, 120], np.uint64),
    shutter_type=ShutterType.GLOBAL,
    external_distortion_parameters=None,
    principal_point=np.array([80.0, 60.0], np.float32),
    focal_length=np.array([60.0, 60.0], np.float32),
    radial_coeffs=np.zeros(4, np.float32),
    max_angle=1.5,
)
FTHETA = FThetaCameraModelParameters(
    resolution=FISHEYE.resolution,
    shutter_type=ShutterType.GLOBAL,
    external_distortion_parameters=None,
    principal_point=np.array([79.5, 59.5], np.float32),  # pixel centres at whole numbers
    reference_poly=FThetaCameraModelParameters.PolynomialType.ANGLE_TO_PIXELDIST,
    pixeldist_to_angle_poly=np.array([0, 1 / 60, 0, 0, 0, 0], np.float32),
    angle_to_pixeldist_poly=np.array([0, 60, 0, 0, 0, 0], np.float32),
    max_angle=1.5,
)
"""The same lens in NVIDIA's own model."""
LEFT, RIGHT = np.eye(4), np.eye(4)
LEFT[:3, 3], RIGHT[:3, 3] = (1.0, 0.8, 1.8), (1.0, -0.8, 1.8)
RIGHT[:3, :3] = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
THING = (pose_at(100.2) @ [12.0, 1.5, 1.0, 1.0])[:3]
"""A static thing in the world."""


def rays(mounted: np.ndarray, at_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions and distances to THING from a lidar at the times of its rays."""
    seen = [np.linalg.inv(pose_at(t * 1e-6) @ mounted) @ [*THING, 1.0] for t in at_us.tolist()]
    xyz = np.stack(seen)[:, :3]
    distance = np.linalg.norm(xyz, axis=1)
    return (xyz / distance[:, None]).astype(np.float32), distance.astype(np.float32)


def write_foreign(
    folder: Path,
    store_type: str = "itar",
    lens: CameraModelParameters = FISHEYE,
    *,
    poses: bool = True,
    left: np.ndarray = LEFT,
) -> Path:
    """A sequence as another program writes it.

    Two lidars at 10 Hz with two returns, one of them turned; a fisheye at 20 Hz; a box in the frame of the
    lidar that is mounted at `left`.
    """
    end_us = START_US + 4 * SWEEP_US
    writer = SequenceComponentGroupsWriter(
        UPath(folder), "drive 1", "drive 1", HalfClosedInterval(START_US, end_us + 1), {}, store_type
    )
    register = writer.register_component_writer
    if poses:
        graph = register(PosesComponent.Writer, "own")
        t_us = np.arange(START_US, end_us + 1, 10_000)
        graph.store_dynamic_pose(
            "rig", "world", np.stack([pose_at(t * 1e-6) for t in t_us.tolist()]), t_us.astype(np.uint64)
        )
        for name, mounted in (
            ("left", left),
            ("right", RIGHT),
            ("fish", CAMERA.T_ego_cam.astype(np.float64)),
        ):
            graph.store_static_pose(name, "rig", mounted)
    register(IntrinsicsComponent.Writer, "own").store_camera_intrinsics("fish", lens)
    for name, mounted in (("left", left), ("right", RIGHT)):
        lidar = register(LidarSensorComponent.Writer, name, name)
        for sweep in range(4):
            span_us = np.array([START_US + sweep * SWEEP_US, START_US + (sweep + 1) * SWEEP_US], np.uint64)
            at_us = np.linspace(*span_us.astype(np.int64), 5).astype(np.uint64)
            direction, distance = rays(mounted, at_us)
            nothing = np.full(5, np.nan, np.float32)
            first, second = distance.copy(), distance + 1
            first[1], second[1], first[2] = np.nan, np.nan, np.nan  # one ray returns nothing, one only late
            second[2] = distance[2]
            returns = np.stack([first, second, nothing])
            intensity = np.where(np.isnan(returns), np.nan, 0.5).astype(np.float32)
            lidar.store_frame(direction, at_us, None, returns, intensity, span_us, {}, {})
    camera = register(CameraSensorComponent.Writer, "fish", "fish")
    register(MasksComponent.Writer, "own").store_camera_masks("fish", {"ego": Image.new("L", (160, 120))})
    for shot in range(8):
        begin_us = START_US + shot * SWEEP_US // 2
        camera.store_frame(fisheye_image(begin_us), "png", np.array([begin_us, begin_us], np.uint64), {}, {})
    # A box around THING, seen in the middle of the second sweep, in the frame of a lidar at that time
    seen_us = START_US + SWEEP_US * 3 // 2
    upright = left if np.linalg.det(left) > 0 else LEFT
    box = box_of_thing(np.linalg.inv(pose_at(seen_us * 1e-6) @ upright))
    source = LabelSource.AUTOLABEL
    register(CuboidsComponent.Writer, "own").store_observations(
        [
            CuboidTrackObservation("a-1", "automobile", seen_us, "left", seen_us, box, source),
            CuboidTrackObservation("b-2", "hovercraft", seen_us, "left", seen_us, box, source),
        ]
    )
    writer.finalize()
    return folder


def box_of_thing(T_lidar_world: np.ndarray) -> BBox3:
    """The upright box around THING with a heading of 0.3 in the world, as the library moves it to a lidar."""
    box = transform_bbox(np.array([*THING, 4.0, 2.0, 1.5, 0.0, 0.0, 0.3]), T_lidar_world)
    return BBox3.from_array(box)


def fisheye_image(t_us: int) -> bytes:
    """Black, with a white square around THING by the equidistant projection."""
    x, y, z, _ = np.linalg.inv(pose_at(t_us * 1e-6) @ CAMERA.T_ego_cam) @ [*THING, 1.0]
    off = np.hypot(x, y)
    u, v = np.array([80.0, 60.0]) + 60.0 * np.arctan2(off, z) * np.array([x, y]) / off
    pixels = np.zeros((120, 160, 3), np.uint8)
    pixels[int(v) - 2 : int(v) + 3, int(u) - 2 : int(u) + 3] = 255
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


@pytest.mark.parametrize(("store_type", "lens"), [("itar", FISHEYE), ("directory", FTHETA)])
def test_a_sequence_of_another_program(store_type: str, lens: CameraModelParameters, tmp_path: Path) -> None:
    (path,) = convert(write_foreign(tmp_path / "raw", store_type, lens), "ncore", tmp_path / "out")
    assert path.folder.name == "drive-1"
    log = Log(path)
    # The frames are at the ends of the sweeps
    np.testing.assert_array_equal(log.t_us, START_US + SWEEP_US * np.arange(1, 5))
    for frame, t_us in enumerate(log.t_us.tolist()):
        np.testing.assert_allclose(log.T_world_ego[frame], pose_at(t_us * 1e-6), atol=1e-6)
        read = read_sweep(log, frame)
        assert read is not None
        sweep, misses_known = read
        assert misses_known
        assert (sweep.returned.sum(), len(sweep.returned)) == (8, 10)
        # Both lidars see the thing where it is, at each time and by each return
        T = log.T_world_ego[frame]
        points = sweep.points_ego[sweep.returned].double().numpy() @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(points, np.tile(THING, (8, 1)), atol=2e-3)
    (camera,) = pinhole_cameras(log).values()
    for frame in (0, 3):
        shown = read_camera(log, frame, camera, (120, 160), with_image=True)
        assert shown.exposed_dt_s == pytest.approx(0.0 if frame < 3 else -0.05)
        assert shown.image is not None
        T_cam_world = np.linalg.inv(log.T_world_ego[frame] @ shown.T_ego_cam.double().numpy())
        x, y, z = (shown.K.double().numpy() @ (T_cam_world @ [*THING, 1.0])[:3]).tolist()
        v, u = (shown.image.float().mean(0) > 120).nonzero().double().mean(0).tolist()
        assert (u + 0.5, v + 0.5) == pytest.approx((x / z, y / z), abs=1.5)
    annotated = [read_boxes(log, frame) for frame in range(4)]
    assert [boxes is None for boxes in annotated] == [True, False, True, True]
    boxes = annotated[1]
    assert boxes is not None
    T = log.T_world_ego[1]
    np.testing.assert_allclose(
        boxes.centre.double().numpy() @ T[:3, :3].T + T[:3, 3], [THING, THING], atol=2e-3
    )
    heading = boxes.yaw + np.arctan2(T[1, 0], T[0, 0])
    assert torch.cos(heading - 0.3).tolist() == pytest.approx([1.0, 1.0], abs=1e-5)
    assert boxes.category.tolist() == [Category.CAR, Category.OTHER]
    told = "\n".join(read_notices(path.folder))
    for fact in ("hovercraft", lens.type(), "several returns", "vehicle-bbox", "masks"):
        assert fact in told


@pytest.mark.parametrize(("axis", "angle_rad"), [("y", 0.35), ("x", np.pi), ("xy", (np.pi, 0.35))])
def test_boxes_of_lidars_that_are_not_upright(axis: str, angle_rad: Any, tmp_path: Path) -> None:
    """A lidar that is pitched, and one upside down: the library's angles are about fixed axes."""
    mounted = LEFT.copy()
    mounted[:3, :3] = Rotation.from_euler(axis, angle_rad).as_matrix()
    (path,) = convert(write_foreign(tmp_path / "raw", left=mounted), "ncore", tmp_path / "out")
    log = Log(path)
    boxes, T = read_boxes(log, 1), log.T_world_ego[1]
    assert boxes is not None
    centre = boxes.centre.double().numpy() @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(centre, [THING, THING], atol=2e-3)
    heading = boxes.yaw + np.arctan2(T[1, 0], T[0, 0])
    assert torch.cos(heading - 0.3).tolist() == pytest.approx([1.0, 1.0], abs=1e-5)


def test_a_lidar_whose_mount_mirrors_is_refused(tmp_path: Path) -> None:
    raw = write_foreign(tmp_path / "raw", left=LEFT @ np.diag([1.0, -1.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="the mount of left mirrors"):
        convert(raw, "ncore", tmp_path / "out")


def test_bad_sequences(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw, out = tmp_path / "raw", tmp_path / "out"
    with pytest.raises(InputError, match="the sequence has no poses"):
        convert(write_foreign(raw, poses=False), "ncore", out)
    write_foreign(raw)
    (store,) = raw.glob("*.ncore4-left.zarr.itar")
    whole = store.read_bytes()
    store.write_bytes(whole[: len(whole) // 2])
    assert main(["convert", "ncore", str(raw), "--out", str(out)]) == 2
    told = capsys.readouterr().err.strip()
    assert "\n" not in told
    assert str(raw) in told
    assert not list(out.rglob("sync.arrow"))


def test_without_the_package_one_line_says_how_to_get_it(
    tmp_path: Path, source: LogPath, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = write_foreign(tmp_path / "raw")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    for verb in (["convert", "ncore", str(raw)], ["export", "ncore", str(source.folder)]):
        assert main([*verb, "--out", str(tmp_path / "out")]) == 2
        assert "needs the package nvidia-ncore: pip install 'foredrive[ncore]'" in capsys.readouterr().err


def test_nothing_of_a_store_is_unpickled(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "touched",))

    write_foreign(tmp_path / "raw", "directory")
    numcodecs.register_codec(numcodecs.Pickle)
    (store,) = (tmp_path / "raw").glob("*.ncore4-left.zarr")
    frames = zarr.open_group(str(store))["lidars/left/frames"]
    values = np.empty(5, dtype=object)
    values[:] = [Evil() for _ in range(5)]
    for frame in frames:
        bundle = frames[frame]["ray_bundle"]
        del bundle["direction"]
        path = f"{bundle.path}/direction"
        codec = numcodecs.Pickle()
        array = zarr.empty(5, dtype=object, object_codec=codec, store=bundle.store, path=path)
        array[:] = values
    consolidate_compressed_metadata(frames.store)
    with pytest.raises(InputError, match=r"none of its sweeps can be read.*MetadataError"):
        convert(tmp_path / "raw", "ncore", tmp_path / "out")
    assert not (tmp_path / "touched").exists()


def test_options_of_the_verb(source: LogPath, exported: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", "ncore", str(source.folder), "--out", str(exported)]) == 0
    assert "kept" in capsys.readouterr().out
    assert main(["export", "ncore", "--out", str(exported)]) == 2
    assert "needs a log" in capsys.readouterr().err
