"""Rigid motions."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.geometry.se3 import (
    exp_se3,
    inverse_se3,
    log_so3,
    matrix_from_yaw,
    transform_points,
    yaw_from_matrix,
)

small = st.floats(-1.7, 1.7, allow_nan=False)
six = st.tuples(*[small] * 6)


@given(six)
def test_exponential_is_a_rigid_motion_and_inverts(xi: tuple[float, ...]) -> None:
    T = exp_se3(torch.tensor(xi, dtype=torch.float64))
    eye = torch.eye(4, dtype=torch.float64)
    torch.testing.assert_close(T[:3, :3] @ T[:3, :3].T, eye[:3, :3], atol=1e-9, rtol=0)
    torch.testing.assert_close(inverse_se3(T) @ T, eye, atol=1e-9, rtol=0)
    torch.testing.assert_close(
        exp_se3(-torch.tensor(xi, dtype=torch.float64)), inverse_se3(T), atol=1e-6, rtol=0
    )


@given(six)
def test_exponential_agrees_with_the_matrix_exponential(xi: tuple[float, ...]) -> None:
    rho, (x, y, z) = xi[:3], xi[3:]
    generator = torch.zeros(4, 4, dtype=torch.float64)
    generator[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    generator[:3, 3] = torch.tensor(rho, dtype=torch.float64)
    expected = torch.linalg.matrix_exp(generator)
    torch.testing.assert_close(exp_se3(torch.tensor(xi, dtype=torch.float64)), expected, atol=1e-6, rtol=0)


def test_gradient_at_identity_is_finite() -> None:
    xi = torch.zeros(6, requires_grad=True)
    exp_se3(xi).sum().backward()
    assert xi.grad is not None
    assert xi.grad.isfinite().all()


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_log_inverts_exp_of_rotations(phi: tuple[float, ...]) -> None:
    xi = torch.tensor((0.0, 0.0, 0.0, *phi), dtype=torch.float64)
    torch.testing.assert_close(log_so3(exp_se3(xi)[:3, :3]), xi[3:], atol=1e-6, rtol=0)


def test_quarter_turn_by_hand() -> None:
    T = matrix_from_yaw(torch.tensor(math.pi / 2), torch.tensor([10.0, 0.0, 1.0]))
    moved = transform_points(T, torch.tensor([[2.0, 0.0, 0.0]]))
    torch.testing.assert_close(moved, torch.tensor([[10.0, 2.0, 1.0]]))
    torch.testing.assert_close(yaw_from_matrix(T), torch.tensor(math.pi / 2))
