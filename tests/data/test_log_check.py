"""The check of a log: a sound log has no findings, and each fault is found and named."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arrow_surgery import rewrite_column
from scipy.spatial.transform import Rotation

from foredrive.data import Box, CameraSpec, Points, find_logs, write_log
from foredrive.data.log_check import LogCheck, check_log
from foredrive.data.mosaic_check import has_pattern
from foredrive.view.check_table import check_table

FRAMES, SPEED_MPS = 20, 6.0
SIZE_HW = (24, 32)
CAMERA = CameraSpec(
    "front",
    np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32),
    np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]], np.float32),
    SIZE_HW,
)


def sound_drive() -> dict[str, Any]:
    """Two seconds along a street in a curve, with images that change, and a car ahead with points."""
    t_s = 0.1 * np.arange(FRAMES)
    yaw = 0.2 * t_s
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    T[:, 0, 3], T[:, 1, 3] = 30 * np.sin(yaw), 30 * (1 - np.cos(yaw))  # 6 m/s on a radius of 30 m
    rng = np.random.default_rng(0)
    car = rng.uniform([9, 1, 0.3], [13, 3, 1.4], (60, 3))
    street_m = street(rng)
    sweeps = []
    for T_world_ego in T:
        xyz = (street_m - T_world_ego[:3, 3]) @ T_world_ego[:3, :3]
        xyz = np.concatenate([xyz[np.linalg.norm(xyz, axis=1) < 16], car])
        sweeps.append(Points(xyz, dt_s=np.linspace(-0.05, 0.04, len(xyz))))
    return {
        "t_s": t_s,
        "T_world_ego": T,
        "cameras": [CAMERA],
        "images": {"front": [rng.integers(0, 255, (*SIZE_HW, 3), dtype=np.uint8) for _ in t_s]},
        "sweeps": sweeps,
        "boxes": [[Box("car", 3, (11.0, 2.0, 0.75), (4.0, 2.0, 1.5), 0.0, (6.0, 0.0))]] * FRAMES,
    }


def street(rng: np.random.Generator) -> np.ndarray:
    """Points of a road, of a wall on each side, and of the front of a house, in the world."""
    x, y = np.meshgrid(np.arange(-20, 30, 0.5), np.arange(-20, 30, 0.5))
    along, up = np.meshgrid(np.arange(-20, 30, 0.4), np.arange(0.2, 4, 0.4))
    road = np.stack([x, y, rng.uniform(-0.02, 0.02, x.shape)], axis=-1)
    walls = [np.stack([along, np.full_like(up, side), up], axis=-1) for side in (-6.0, 11.0)]
    front = np.stack([np.full_like(up, 17.0), along, up], axis=-1)
    return np.concatenate([part.reshape(-1, 3) for part in (road, *walls, front)])


def checked(tmp_path: Path, **changed: Any) -> LogCheck:
    write_log(tmp_path, "drive", **(sound_drive() | changed))
    return check_log(find_logs(tmp_path)[0])


def test_a_sound_log(tmp_path: Path) -> None:
    check = checked(tmp_path)
    assert check.findings == []
    assert (check.frames, check.duration_s) == (FRAMES, pytest.approx(1.9))
    assert check.driven_m == pytest.approx(SPEED_MPS * 1.9, rel=1e-3)
    streams = {stream.name: stream for stream in check.streams}
    assert streams["camera.pcam_f0"].detail == "front, 32 x 24 px"
    assert streams["lidar.lidar_top"].period_s == pytest.approx(0.1)
    assert "no problems" in check_table(check).title


DRIVE = sound_drive()
TIMES_S = DRIVE["t_s"]


def with_jump() -> np.ndarray:
    T = DRIVE["T_world_ego"].copy()
    T[10:, :3, 3] += [0.0, 1.5, 0.0]
    return T


def without(values: list[Any], gone: range) -> list[Any]:
    return [None if frame in gone else value for frame, value in enumerate(values)]


def moved(sweeps: list[Points], change: Any) -> list[Points]:
    return [dataclasses.replace(points, xyz_m=change(points.xyz_m)) for points in sweeps]


def turned(axis: str, degrees: float) -> list[Points]:
    """The sweeps of a lidar whose mount is turned, 1.8 m above the ground."""
    R, at_m = Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), np.array([0.0, 0.0, 1.8])
    return moved(DRIVE["sweeps"], lambda xyz_m: (xyz_m - at_m) @ R.T + at_m)


def over_a_hole() -> np.ndarray:
    """Poses that were interpolated from 0.4 to 1.5 s."""
    T = DRIVE["T_world_ego"].copy()
    share = np.linspace(0, 1, 12)[:, None]
    T[4:16, :3, 3] = T[4, :3, 3] + share * (T[15, :3, 3] - T[4, :3, 3])
    return T


def looking(axis: str, degrees: float) -> list[CameraSpec]:
    """The camera, turned about one of its own axes."""
    T = CAMERA.T_ego_cam.astype(np.float64)
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return [dataclasses.replace(CAMERA, T_ego_cam=T)]


def mosaic(image: np.ndarray) -> np.ndarray:
    """Return the grey image of a sensor behind filters red, green, green, blue."""
    grey = image[..., 1].copy()
    grey[::2, ::2], grey[1::2, 1::2] = image[::2, ::2, 0], image[1::2, 1::2, 2]
    return np.repeat(grey[..., None], 3, axis=-1)


COLOURFUL = np.array([200, 110, 40]) + np.random.default_rng(0).integers(0, 30, (*SIZE_HW, 3))
MOSAICS = [mosaic(np.roll(COLOURFUL, 2 * frame, axis=1).astype(np.uint8)) for frame in range(FRAMES)]
STRETCHED = np.array([[1, 1, 1], [1, 1.05, 1], [1, 1, 1]], np.float32)
EVERY_TENTH = [np.arange(len(one.xyz_m))[:, None] % 10 == 0 for one in DRIVE["sweeps"]]
MISREAD = [
    dataclasses.replace(one, xyz_m=np.where(tenth, one.xyz_m - [0, 0, 40.0], one.xyz_m))
    for one, tenth in zip(DRIVE["sweeps"], EVERY_TENTH, strict=True)
]
DOWNHILL = moved(DRIVE["sweeps"], lambda xyz_m: xyz_m - [0, 0, 0.15] * np.abs(xyz_m[:, :1]))
LIFTED = moved(DRIVE["sweeps"], lambda xyz_m: xyz_m + np.array([0, 0, 0.9]))
SIDEWAYS = DRIVE["T_world_ego"] @ np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
TIPPED = DRIVE["T_world_ego"] @ np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
FAR = [[Box("car", 3, (11.0, -2.0, 9.0), (4.0, 2.0, 1.5), 0.0)]] * FRAMES
FAST = [[Box("car", 3, (11.0, 2.0, 0.75), (4.0, 2.0, 1.5), 0.0, (90.0, 0.0))]] * FRAMES


@pytest.mark.parametrize(
    ("changed", "subject", "text"),
    [
        (
            {"T_world_ego": with_jump()},
            "ego poses",
            r"accelerates by \d+\.\d m/s² at (0\.9|1\.0)0 s \(2 frames",
        ),
        ({"T_world_ego": SIDEWAYS}, "ego poses", "along its own x axis by -?[01]%"),
        ({"T_world_ego": TIPPED}, "ego poses", r"tilted by 1\.6 rad"),
        ({"sweeps": LIFTED}, "lidar", r"the ground is at z = 0\.\d+ m"),
        (
            {"sweeps": turned("z", 5.0)},
            "lidar",
            r"pairs of sweeps .*turned by -[456]\.\d° to the left and -?0\.",
        ),
        ({"sweeps": turned("y", 5.0)}, "lidar", r"pairs of sweeps .*to the left and [456]\.\d° up"),
        ({"sweeps": [DRIVE["sweeps"][0]] * FRAMES}, "lidar", "pairs of sweeps .* do not lie on each other"),
        (
            {"cameras": [dataclasses.replace(CAMERA, K=CAMERA.K * STRETCHED)]},
            "front",
            r"30\.0 and 31\.5 px: were",
        ),
        ({"T_world_ego": over_a_hole()}, "ego poses", r"from 0\.40 to 1\.50 s the path is a straight line"),
        (
            {"cameras": looking("x", 90.0)},
            "front",
            "no lidar point falls into its images; it looks 90° above",
        ),
        (
            {"sweeps": without(DRIVE["sweeps"], range(5, 9))},
            "lidar.lidar_top",
            r"1 gap; it lasts 0\.50 s, from 0\.40 s",
        ),
        ({"sweeps": [Points(np.zeros((0, 3)))] * FRAMES}, "lidar", "12 of 12 sampled sweeps are empty"),
        ({"sweeps": [Points(one.xyz_m) for one in DRIVE["sweeps"]]}, "lidar", "no times of their own"),
        (
            {"images": {"front": DRIVE["images"]["front"][:1] * FRAMES}},
            "front",
            "do not change while driving",
        ),
        (
            {"images": {"front": [np.zeros((*SIZE_HW, 3), np.uint8)] * FRAMES}},
            "front",
            "sampled images are black",
        ),
        ({"image_t_s": {"front": TIMES_S + 0.4}}, "front", r"exposed up to 0\.400 s .* another clock"),
        ({"image_t_s": {"front": TIMES_S * 1.03}}, "front", r"its time varies by 0\.0\d+ s"),
        ({"images": {"front": MOSAICS}}, "front", "grey images have the pattern of a colour filter"),
        ({"sweeps": MISREAD}, "lidar", r"(9|10|11)% of the points are far below the ground"),
        ({"boxes": FAR}, "boxes", "12 of 12 sampled boxes within 25 m have no lidar point"),
        ({"boxes": FAST}, "boxes", "1 tracks move at up to 90 m/s"),
    ],
)
def test_a_fault_is_found(changed: dict[str, Any], subject: str, text: str, tmp_path: Path) -> None:
    findings = checked(tmp_path, **changed).findings
    told = [finding.text for finding in findings if finding.subject == subject]
    assert any(re.search(text, each) for each in told), findings


def test_a_vehicle_that_stops_hard_was_not_interpolated(tmp_path: Path) -> None:
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[1:, 0, 3] = np.cumsum([0.2, 0.15, 0.09, 0.04, *[0.0] * 11, 0.04, 0.09, 0.15, 0.2])
    texts = [finding.text for finding in checked(tmp_path, T_world_ego=T, sweeps=None).findings]
    assert not any("straight line" in text for text in texts)


def test_points_of_a_steep_road_are_not_below_the_ground(tmp_path: Path) -> None:
    texts = [finding.text for finding in checked(tmp_path, sweeps=DOWNHILL).findings]
    assert not any("below the ground" in text for text in texts)


def test_grey_images_and_noise_are_no_mosaics() -> None:
    """Smooth and random grey images, stripes along one axis, a flat image, and a mosaic in colour."""
    noise = np.random.default_rng(1).integers(0, 256, (40, 60))
    smooth = np.cumsum(noise - 127, axis=1) // 8 % 256
    stripes = np.tile([[0], [200]], (20, 60))
    for grey in (noise, smooth, stripes, np.full((40, 60), 90)):
        assert not has_pattern(np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8))
    coloured = MOSAICS[0].copy()
    assert has_pattern(coloured)
    coloured[..., 2] //= 2
    assert not has_pattern(coloured)


def test_a_gap_of_several_streams_is_one_finding(tmp_path: Path) -> None:
    gone = range(5, 9)
    images = {"front": without(DRIVE["images"]["front"], gone)}
    findings = checked(tmp_path, images=images, sweeps=without(DRIVE["sweeps"], gone)).findings
    (gap,) = [finding for finding in findings if "gap" in finding.text]
    assert gap.subject == "2 streams"
    assert "(usually 0.100 s): " in gap.text
    assert all(name in gap.text for name in ("camera.pcam_f0", "lidar.lidar_top"))


def test_a_sweep_that_cannot_be_read_is_told_once_and_the_rest_is_checked(tmp_path: Path) -> None:
    path = write_log(tmp_path, "drive", **(sound_drive() | {"boxes": FAST}))
    file = path.folder / "lidar.lidar_top.arrow"
    rewrite_column(file, "lidar.lidar_top.data", lambda values: [b"damaged"] * len(values))
    findings = check_log(path).findings
    assert [finding.subject for finding in findings if finding.level == "problem"].count("boxes") == 1
    assert any(finding.subject == "lidar" for finding in findings)
