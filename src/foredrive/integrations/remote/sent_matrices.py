"""Matrices of messages: lists of rows, checked."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor

from foredrive.errors import InputError


def read_matrix(rows: Sequence[Sequence[float]], size: int, what: str) -> Float64[Tensor, "N N"]:
    """Return a square matrix.

    Raises:
        InputError: it is of another size, or not finite.
    """
    if len(rows) != size or any(len(row) != size for row in rows):
        raise InputError(f"{what} has to be a {size} by {size} matrix")
    matrix = torch.tensor(rows, dtype=torch.float64)
    if not bool(matrix.isfinite().all()):
        raise InputError(f"{what} has to be finite")
    return matrix


def read_pose(rows: Sequence[Sequence[float]], what: str) -> Float64[Tensor, "4 4"]:
    """Return a pose of a message.

    Raises:
        InputError: it is no finite rigid transform.
    """
    T = read_matrix(rows, 4, what)
    R = T[:3, :3]
    rigid = torch.allclose(R @ R.T, torch.eye(3, dtype=T.dtype), atol=1e-3) and float(torch.det(R)) > 0
    if not rigid or not torch.equal(T[3], torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=T.dtype)):
        raise InputError(f"{what} has to be a rigid transform: a rotation, and 0 0 0 1 in the last row")
    return T
