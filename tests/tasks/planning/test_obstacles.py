"""Moving the boxes of a drive into the ego frame at now."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.geometry.se3 import exp_se3, inverse_se3, matrix_from_yaw, transform_points
from foredrive.scene import Boxes, CameraRig, Clip, LidarSweep, Trajectory
from foredrive.scene.boxes import unlabelled
from foredrive.tasks.planning.obstacles import boxes_at_now, future_obstacles


def drive(t_s: list[float], T_world_ego: torch.Tensor, centre: torch.Tensor, valid: torch.Tensor) -> Clip:
    """One clip [1 T] without sensors; boxes of M tracks are given in the ego frame of their frame."""
    t, m = centre.shape[:2]
    nothing = torch.zeros(1, t, 0)
    return Clip(
        t_s=torch.tensor([t_s]),
        T_world_ego=T_world_ego[None].double(),
        images=torch.zeros(1, t, 0, 3, 1, 1, dtype=torch.uint8),
        image_valid=torch.zeros(1, t, 0, dtype=torch.bool),
        rig=CameraRig(
            K=torch.zeros(1, t, 0, 3, 3),
            T_ego_cam=torch.zeros(1, t, 0, 4, 4),
            dist=torch.zeros(1, t, 0, 5),
            readout_s=nothing,
            names=(),
            size_hw=(1, 1),
        ),
        sweeps=LidarSweep(
            origin_ego=torch.zeros(1, t, 0, 3),
            dir_ego=torch.zeros(1, t, 0, 3),
            range_m=nothing,
            returned=nothing.bool(),
            intensity=nothing,
            dt_s=nothing,
            beam=nothing.long(),
            valid=nothing.bool(),
        ),
        sweep_valid=torch.zeros(1, t, dtype=torch.bool),
        misses_known=torch.zeros(1, t, dtype=torch.bool),
        boxes=Boxes(
            centre=centre[None],
            size_lwh=torch.ones(1, t, m, 3),
            yaw=torch.zeros(1, t, m),
            velocity=torch.tensor([1.0, 0.0]).expand(1, t, m, 2),
            track_id=torch.arange(m).expand(1, t, m),
            category=torch.zeros(1, t, m, dtype=torch.long),
            valid=valid[None],
            **unlabelled(1, t, m),
        ),
        boxes_valid=torch.ones(1, t, dtype=torch.bool),
        ego_speed_mps=torch.zeros(1, t),
        ego_speed_valid=torch.zeros(1, t, dtype=torch.bool),
        command=torch.zeros(1, dtype=torch.long),
        command_valid=torch.zeros(1, dtype=torch.bool),
        route_xy=torch.zeros(1, 7, 2),
        route_valid=torch.zeros(1, 7, dtype=torch.bool),
        future=Trajectory(
            xy=torch.zeros(1, 1, 6, 2),
            yaw=torch.zeros(1, 1, 6),
            valid=torch.zeros(1, 1, 6, dtype=torch.bool),
            log_prob=torch.zeros(1, 1),
            dt_s=0.5,
        ),
    )


def poses(*xy_yaw: tuple[float, float, float]) -> torch.Tensor:
    return torch.stack(
        [
            matrix_from_yaw(
                torch.tensor(yaw, dtype=torch.float64), torch.tensor([x, y, 0.0], dtype=torch.float64)
            )
            for x, y, yaw in xy_yaw
        ]
    )


def test_a_box_seen_from_a_turned_vehicle() -> None:
    # At now the vehicle is at (1000, 2000), heading along world y; at 0.5 s it is 5 m on and faces world -x.
    # A box 10 m ahead of it then lies, seen from now, 5 m ahead and 10 m to the left, pointing left.
    clip = drive(
        [0.0, 0.5],
        poses((1000.0, 2000.0, 0.5 * math.pi), (1000.0, 2005.0, math.pi)),
        centre=torch.tensor([[[0.0, 0.0, 0.0]], [[10.0, 0.0, 1.0]]]),
        valid=torch.ones(2, 1, dtype=torch.bool),
    )
    boxes = boxes_at_now(clip)
    torch.testing.assert_close(boxes.centre[0, 1, 0], torch.tensor([5.0, 10.0, 1.0]))
    torch.testing.assert_close(boxes.yaw[0, 1, 0], torch.tensor(0.5 * math.pi))
    torch.testing.assert_close(boxes.velocity[0, 1, 0], torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0)
    assert boxes.centre[0, 0].tolist() == [[0.0, 0.0, 0.0]]  # the frame at now stays


def test_who_was_seen_when() -> None:
    t_s = [-2.0, -1.0, -0.5, 0.0, 0.5, 1.0]
    # Tracks: 0 always there, 1 hidden at now, 2 seen two seconds ago only, 3 new at 0.5 s, 4 gone after now.
    seen = torch.tensor(
        [
            [1, 0, 1, 0, 0],
            [1, 0, 0, 0, 0],
            [1, 1, 0, 0, 1],
            [1, 0, 0, 0, 1],
            [1, 1, 1, 1, 0],
            [1, 1, 0, 1, 0],
        ],
        dtype=torch.bool,
    )
    clip = drive(t_s, poses(*[(0.0, 0.0, 0.0)] * 6), torch.zeros(6, 5, 3), seen)
    obstacles = future_obstacles(clip, steps=3, step_s=0.5)
    assert obstacles.annotated.tolist() == [[True, True, False]]  # the clip ends at 1 s
    assert obstacles.boxes.valid[0].tolist() == [*seen[4:].tolist(), [False] * 5]
    assert obstacles.tracked_now[0, 0].tolist() == [True, False, False, False, False]
    assert obstacles.tracked_lately[0, 0].tolist() == [True, True, False, False, False]
    assert bool(obstacles.annotated_now.all())


def test_frames_near_a_step_stand_for_it_and_others_do_not() -> None:
    clip = drive(
        [0.0, 0.45, 1.3],
        poses(*[(0.0, 0.0, 0.0)] * 3),
        torch.zeros(3, 1, 3),
        torch.ones(3, 1, dtype=torch.bool),
    )
    assert future_obstacles(clip, steps=2, step_s=0.5).annotated.tolist() == [[True, False]]
    clip.boxes_valid[0, 1] = False
    assert future_obstacles(clip, steps=2, step_s=0.5).annotated.tolist() == [[False, False]]


def test_an_unbatched_clip_is_refused() -> None:
    clip = drive([0.0], poses((0.0, 0.0, 0.0)), torch.zeros(1, 1, 3), torch.ones(1, 1, dtype=torch.bool))
    with pytest.raises(InputError, match="batch"):
        future_obstacles(clip[0], steps=1, step_s=0.5)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.floats(-1e5, 1e5))
def test_a_point_fixed_in_the_world_stays_where_it_is(motion: list[float], far: float) -> None:
    start = poses((far, -far, 0.3))[0]
    later = start @ exp_se3(torch.tensor(motion, dtype=torch.float64))
    world = transform_points(start, torch.tensor([[4.0, 5.0, 6.0]], dtype=torch.float64))
    centre = transform_points(inverse_se3(later), world)
    clip = drive(
        [0.0, 0.5],
        torch.stack([start, later]),
        torch.stack([torch.zeros(1, 3), centre.float()]),
        torch.ones(2, 1, dtype=torch.bool),
    )
    torch.testing.assert_close(
        boxes_at_now(clip).centre[0, 1, 0], torch.tensor([4.0, 5.0, 6.0]), atol=1e-3, rtol=0
    )
