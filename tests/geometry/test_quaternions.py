"""Quaternions against rotation matrices."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.geometry.quaternions import multiply_quaternions, quaternion_from_matrix
from foredrive.geometry.se3 import exp_se3

angle = st.floats(-3.14, 3.14)


def matrix(q: torch.Tensor) -> torch.Tensor:
    """By turning the unit vectors: q v q*."""
    back = q * torch.tensor([1.0, -1, -1, -1], dtype=q.dtype)
    axes = torch.nn.functional.pad(torch.eye(3, dtype=q.dtype), (1, 0))
    return multiply_quaternions(multiply_quaternions(q.expand(3, 4), axes), back.expand(3, 4))[:, 1:].T


@given(angle, angle, angle)
def test_a_matrix_comes_back(x: float, y: float, z: float) -> None:
    R = exp_se3(torch.tensor([0.0, 0, 0, x, y, z], dtype=torch.float64))[:3, :3]
    assert torch.allclose(matrix(quaternion_from_matrix(R)), R, atol=1e-12)


@given(angle, angle, angle, angle)
def test_products_are_those_of_matrices(a: float, b: float, c: float, d: float) -> None:
    R = exp_se3(torch.tensor([[0.0, 0, 0, a, b, 0], [0, 0, 0, 0, c, d]], dtype=torch.float64))[:, :3, :3]
    product = multiply_quaternions(quaternion_from_matrix(R[0]), quaternion_from_matrix(R[1]))
    assert torch.allclose(matrix(product), R[0] @ R[1], atol=1e-12)


def test_half_turns_have_finite_gradients() -> None:
    for axis in torch.eye(3, dtype=torch.float64):
        R = (2 * axis[:, None] * axis - torch.eye(3, dtype=torch.float64)).requires_grad_()
        q = quaternion_from_matrix(R)
        assert torch.allclose(q.detach(), torch.nn.functional.pad(axis, (1, 0)), atol=1e-12)
        q.sum().backward()
        assert R.grad is not None
        assert R.grad.isfinite().all()


def test_a_quarter_turn_about_z() -> None:
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert torch.allclose(quaternion_from_matrix(R), torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)]))
