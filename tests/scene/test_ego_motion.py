"""Ego motion of the next key frames from measured poses and speeds."""

import dataclasses
import math

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, inverse_se3
from foredrive.scene import CameraRig, Frames
from foredrive.scene.ego_motion import continued_motion

DT_S = 0.5


def frames(
    T_prev_now: Float[Tensor, "4 4"], speeds_mps: tuple[float, float], *, known: bool = True
) -> Frames:
    """Two key frames without cameras."""
    T_now_prev = inverse_se3(T_prev_now.double())
    none = torch.zeros(1, 2, 0, dtype=torch.bool)
    rig = CameraRig(
        K=torch.zeros(1, 2, 0, 3, 3),
        T_ego_cam=torch.zeros(1, 2, 0, 4, 4),
        dist=torch.zeros(1, 2, 0, 5),
        readout_s=torch.zeros(1, 2, 0),
        names=(),
        size_hw=(4, 4),
        exposed_dt_s=torch.zeros(1, 2, 0),
    )
    return Frames(
        t_s=torch.tensor([[-DT_S, 0.0]]),
        T_now_ego=torch.stack([T_now_prev, torch.eye(4, dtype=torch.float64)])[None],
        images=torch.zeros(1, 2, 0, 3, 4, 4, dtype=torch.uint8),
        image_valid=none,
        rig=rig,
        speed_mps=torch.tensor([speeds_mps]),
        speed_valid=torch.full((1, 2), known),
    )


@pytest.mark.parametrize("turn_rad", [0.0, 0.2, -0.4])
def test_at_constant_speed_the_last_motion_repeats(turn_rad: float) -> None:
    last = exp_se3(torch.tensor([4.0, 0.0, 0.1, 0.0, 0.02, turn_rad]))
    motion = continued_motion(frames(last, (8.0, 8.0)), 3)
    torch.testing.assert_close(motion[0], last.expand(3, 4, 4), atol=1e-5, rtol=0)


def test_a_braking_vehicle_goes_less_far_each_step_and_stops() -> None:
    """From 8 to 6 m/s in half a second: 1 m less in each step, after 3 m in the last one."""
    last = exp_se3(torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0, 0.3]))
    motion = continued_motion(frames(last, (8.0, 6.0)), 4)[0]
    travelled = motion[:, :3, 3].norm(dim=-1)
    chord = float(last[:3, 3].norm())
    torch.testing.assert_close(travelled, torch.tensor([chord - 1, chord - 2, max(chord - 3, 0.0), 0.0]))
    yaw = torch.atan2(motion[:, 1, 0], motion[:, 0, 0])
    torch.testing.assert_close(yaw, 0.3 * travelled / chord)  # on the same curve
    assert math.isclose(float(yaw[-1]), 0.0, abs_tol=1e-6)


def test_unknown_speeds_mean_no_acceleration() -> None:
    last = exp_se3(torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    motion = continued_motion(frames(last, (8.0, 2.0), known=False), 2)
    torch.testing.assert_close(motion[0], last.expand(2, 4, 4))


def test_a_standing_vehicle_starts_straight_ahead() -> None:
    """Its pose trembles by 2 mm to the side; at 1 m/s more each step it gains half a metre a step."""
    trembling = exp_se3(torch.tensor([0.0, 0.002, 0.0, 0.0, 0.0, 0.001]))
    motion = continued_motion(frames(trembling, (0.0, 1.0)), 2)[0]
    torch.testing.assert_close(
        motion[:, :3, 3], torch.tensor([[0.5, 0.0, 0.0], [1.0, 0.0, 0.0]]), atol=3e-3, rtol=0
    )
    torch.testing.assert_close(motion[:, :3, :3], torch.eye(3).expand(2, 3, 3))


def test_items_of_a_batch_do_not_mix() -> None:
    turning = frames(exp_se3(torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0, 0.3])), (8.0, 6.0))
    standing = frames(torch.eye(4), (0.0, 1.0))
    both = dataclasses.replace(
        turning,
        **{
            name: torch.cat([getattr(turning, name), getattr(standing, name)])
            for name in ("t_s", "T_now_ego", "speed_mps", "speed_valid")
        },
        images=turning.images.expand(2, -1, -1, -1, -1, -1),
        image_valid=turning.image_valid.expand(2, -1, -1),
        rig=turning.rig.map_tensors(lambda tensor: tensor.expand(2, *tensor.shape[1:])),
    )
    motion = continued_motion(both, 3)
    torch.testing.assert_close(motion[:1], continued_motion(turning, 3))
    torch.testing.assert_close(motion[1:], continued_motion(standing, 3))
