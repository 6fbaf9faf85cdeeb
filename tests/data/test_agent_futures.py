"""Futures of road users, and vehicles over time, from tracks: against paths that are known in closed form."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.data import find_logs
from foredrive.data.boxes import read_boxes
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.truth.agent_futures import read_futures, read_instances
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw
from foredrive.scene import Category
from foredrive.scene.boxes import unlabelled
from foredrive.scene.map_elements import PlaneSpec

STEPS, DT_S = 12, 0.5
CELLS = PlaneSpec((-50.0, -50.0), 0.5, (200, 200))
Poses = Callable[[float], dict[int, tuple[float, float, float]]]
"""World x, y and yaw of each track at a time."""


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    return matrix_from_yaw(torch.tensor(yaw).double(), torch.tensor([x, y, 0.8]).double()).numpy()


def write(
    root: Path,
    tracks: Poses,
    ego: Callable[[float], tuple[float, float, float]],
    seconds: float = 8.0,
    period_s: float = 0.1,
    categories: dict[int, Category] | None = None,
) -> Log:
    """A log of boxes of 4 × 2 × 1.6 m."""
    with LogWriter(root, "flat_train", "log", [], None, None, None) as writer:
        for k in range(round(seconds / period_s) + 1):
            t_s = k * period_s
            T_world_ego = pose(*ego(t_s))
            T_world_ego[2, 3] = 0.0
            there = tracks(t_s)
            T = np.array([pose(*at) for at in there.values()]).reshape(-1, 4, 4)
            T_ego = torch.from_numpy(np.linalg.inv(T_world_ego) @ T)
            count = len(there)
            boxes = dataclasses.replace(
                world.boxes(0.0),
                centre=T_ego[:, :3, 3].float(),
                size_lwh=torch.tensor([[4.0, 2.0, 1.6]]).repeat(count, 1),
                yaw=torch.atan2(T_ego[:, 1, 0], T_ego[:, 0, 0]).float(),
                velocity=torch.full((count, 2), math.nan),
                track_id=torch.tensor(list(there), dtype=torch.int64),
                category=torch.tensor([int((categories or {}).get(t, Category.CAR)) for t in there]).long(),
                valid=torch.ones(count, dtype=torch.bool),
                **unlabelled(count),
            )
            frame = dataclasses.replace(
                world.frame(0, []),
                t_us=world.START_US + round(t_s * 1e6),
                T_world_ego=T_world_ego,
                boxes=boxes,
                sweep=None,
            )
            writer.write(frame)
    return Log(find_logs(root)[0])


def on_circle(
    radius_m: float, turn_radps: float, start: float
) -> Callable[[float], tuple[float, float, float]]:
    """A path around the origin, heading along it."""

    def at(t_s: float) -> tuple[float, float, float]:
        angle = start + turn_radps * t_s
        return radius_m * math.cos(angle), radius_m * math.sin(angle), angle + 0.5 * math.pi

    return at


def still(_t_s: float) -> tuple[float, float, float]:
    return 0.0, 0.0, 0.0


@pytest.mark.parametrize(("period_s", "tolerance_m"), [(0.1, 2e-3), (0.4, 0.02)])
def test_a_car_on_a_circle_from_an_ego_vehicle_on_another(
    period_s: float, tolerance_m: float, tmp_path: Path
) -> None:
    """At 2.5 Hz every other step lies between two boxes: the chord is 1.6 cm off the circle there."""
    car, ego = on_circle(20.0, 0.2, 2.8), on_circle(35.0, -0.15, 0.4)
    log = write(tmp_path, lambda t: {5: car(t)}, ego, period_s=period_s)
    frame = 10
    now_s = frame * period_s
    futures = read_futures(log, frame, STEPS, DT_S)
    T_ego_world = inverse_se3(torch.from_numpy(log.T_world_ego[frame]))
    count = sum(now_s + DT_S * (k + 1) <= 8.0 for k in range(STEPS))
    assert futures.valid[0].tolist() == [True] * count + [False] * (STEPS - count)
    for k in range(count):
        expected = T_ego_world @ torch.from_numpy(pose(*car(now_s + DT_S * (k + 1))))
        torch.testing.assert_close(futures.xy[0, k].double(), expected[:2, 3], atol=tolerance_m, rtol=0)
        turn = float(futures.yaw[0, k]) - math.atan2(expected[1, 0], expected[0, 0])
        assert math.remainder(turn, 2 * math.pi) == pytest.approx(0.0, abs=1e-3)
    assert (futures.yaw.abs() <= math.pi).all()
    assert not futures.xy[0, count:].any()


def test_rows_are_those_of_the_boxes_and_end_with_their_tracks(tmp_path: Path) -> None:
    def tracks(t_s: float) -> dict[int, tuple[float, float, float]]:
        there = {3: (10.0 + 2.0 * t_s, 4.0, 0.0), 1: (20.0, -4.0, 0.0), 9: (5.0, 9.0, 0.0)}
        if t_s > 3.0:
            there.pop(9)
        return there

    log = write(tmp_path, tracks, still)
    boxes, futures = read_boxes(log, 10), read_futures(log, 10, STEPS, DT_S)
    assert boxes is not None
    assert boxes.track_id.tolist() == [3, 1, 9]
    assert futures.valid.sum(-1).tolist() == [12, 12, 4]
    assert futures.xy[0, 11].tolist() == pytest.approx([10.0 + 2.0 * 7.0, 4.0], abs=1e-4)
    assert futures.xy[1, :, 0].tolist() == pytest.approx([20.0] * 12, abs=1e-4)


@pytest.mark.parametrize(
    ("period_s", "missing_s", "valid"),
    [(0.1, (1.9, 2.2), True), (0.5, (1.9, 2.1), False), (0.1, (1.6, 2.5), False)],
)
def test_a_short_gap_of_a_track_is_filled_and_a_missing_key_frame_is_not(
    period_s: float, missing_s: tuple[float, float], valid: bool, tmp_path: Path
) -> None:
    def tracks(t_s: float) -> dict[int, tuple[float, float, float]]:
        return {} if missing_s[0] < t_s < missing_s[1] else {2: (3.0 * t_s, 0.0, 0.0)}

    futures = read_futures(write(tmp_path, tracks, still, period_s=period_s), 0, STEPS, DT_S)
    assert futures.valid[0].tolist() == [True] * 3 + [valid] + [True] * 8
    assert futures.xy[0, 3, 0].item() == pytest.approx(6.0 if valid else 0.0, abs=1e-4)


def test_a_heading_is_interpolated_across_half_a_turn(tmp_path: Path) -> None:
    yaw = {0.0: math.pi - 0.1, 0.4: math.pi + 0.1, 0.8: math.pi + 0.3}
    log = write(tmp_path, lambda t: {1: (5.0, 0.0, yaw[round(t, 1)])}, still, 0.8, 0.4)
    assert read_futures(log, 0, 1, 0.2).yaw.abs().item() == pytest.approx(math.pi, abs=1e-4)
    assert read_futures(log, 0, 1, 0.6).yaw.item() == pytest.approx(-math.pi + 0.2, abs=1e-4)


def test_without_boxes_there_are_no_futures_and_no_valid_steps(tmp_path: Path) -> None:
    log = write(tmp_path, lambda _: {}, still, seconds=1.0)
    assert read_futures(log, 0, STEPS, DT_S).xy.shape == (0, STEPS, 2)
    assert read_instances(log, 0, 2, 0.4, CELLS).valid.all()
    (log.path.folder / "box_detections_se3.arrow").unlink()
    bare = Log(log.path)
    assert read_futures(bare, 0, STEPS, DT_S).xy.shape == (0, STEPS, 2)
    instances = read_instances(bare, 0, 4, DT_S, CELLS)
    assert not instances.valid.any()
    assert not instances.track_id.any()


def test_vehicles_are_drawn_where_they_will_be(tmp_path: Path) -> None:
    """A box of 4 × 2 m has 9 × 5 cells of UniAD: OpenCV draws the outline too."""

    def tracks(t_s: float) -> dict[int, tuple[float, float, float]]:
        there = {0: (10.0 + 4.0 * t_s, 0.0, 0.0), 6: (-20.0, 10.0, 0.5 * math.pi), 4: (0.0, -20.0, 0.0)}
        return there if t_s > 0.75 else {key: there[key] for key in (0, 4)}

    log = write(tmp_path, tracks, still, seconds=1.6, categories={4: Category.PEDESTRIAN})
    instances = read_instances(log, 0, 4, DT_S, CELLS)
    assert instances.valid.tolist() == [True, True, True, True, False]
    for step in range(4):
        rows, columns = np.nonzero(instances.track_id[step].numpy() == 1)
        assert (rows.min(), rows.max()) == (98, 102)
        assert (columns.min(), columns.max()) == (116 + 4 * step, 124 + 4 * step)
        assert len(rows) == 45
    assert set(instances.track_id[1].unique().tolist()) == {0, 1}
    rows, columns = np.nonzero(instances.track_id[2].numpy() == 7)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (116, 124, 58, 62)
    assert not instances.track_id[4].any()
