"""The check of a log: a sound log has no findings, and each fault is found and named."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arrow_surgery import rewrite_column

from foredrive.data import Box, CameraSpec, Points, find_logs, write_log
from foredrive.data.log_check import LogCheck, check_log
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
    """Two seconds along a road in a curve, with images that change, a flat road and a car with points."""
    t_s = 0.1 * np.arange(FRAMES)
    yaw = 0.2 * t_s
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    T[:, 0, 3], T[:, 1, 3] = 30 * np.sin(yaw), 30 * (1 - np.cos(yaw))  # 6 m/s on a radius of 30 m
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(-14, 14, 0.5), np.arange(-14, 14, 0.5))
    road = np.stack([x, y, rng.uniform(-0.02, 0.02, x.shape)], axis=-1).reshape(-1, 3)
    car = rng.uniform([9, 1, 0.3], [13, 3, 1.4], (60, 3))
    wall = np.stack([x, np.full_like(x, 8.0), np.abs(y) / 3 + 0.1], axis=-1).reshape(-1, 3)
    points = Points(
        np.concatenate([road, car, wall]), dt_s=np.linspace(-0.05, 0.04, len(road) + 60 + len(wall))
    )
    return {
        "t_s": t_s,
        "T_world_ego": T,
        "cameras": [CAMERA],
        "images": {"front": [rng.integers(0, 255, (*SIZE_HW, 3), dtype=np.uint8) for _ in t_s]},
        "sweeps": [points] * FRAMES,
        "boxes": [[Box("car", 3, (11.0, 2.0, 0.75), (4.0, 2.0, 1.5), 0.0, (6.0, 0.0))]] * FRAMES,
    }


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


LIFTED = [Points(DRIVE["sweeps"][0].xyz_m + np.array([0, 0, 0.9]), dt_s=DRIVE["sweeps"][0].dt_s)] * FRAMES
SIDEWAYS = DRIVE["T_world_ego"] @ np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
TIPPED = DRIVE["T_world_ego"] @ np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
FAR = [[Box("car", 3, (11.0, -9.0, 3.0), (4.0, 2.0, 1.5), 0.0)]] * FRAMES
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
            {"sweeps": without(DRIVE["sweeps"], range(5, 9))},
            "lidar.lidar_top",
            r"1 gap; it lasts 0\.50 s, from 0\.40 s",
        ),
        ({"sweeps": [Points(np.zeros((0, 3)))] * FRAMES}, "lidar", "12 of 12 sampled sweeps are empty"),
        ({"sweeps": [Points(DRIVE["sweeps"][0].xyz_m)] * FRAMES}, "lidar", "no times of their own"),
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
        ({"boxes": FAR}, "boxes", "12 of 12 sampled boxes within 25 m have no lidar point"),
        ({"boxes": FAST}, "boxes", "1 tracks move at up to 90 m/s"),
    ],
)
def test_a_fault_is_found(changed: dict[str, Any], subject: str, text: str, tmp_path: Path) -> None:
    findings = checked(tmp_path, **changed).findings
    told = [finding.text for finding in findings if finding.subject == subject]
    assert any(re.search(text, each) for each in told), findings


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
