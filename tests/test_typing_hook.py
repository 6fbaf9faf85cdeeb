"""The shapes and dtypes in public signatures are checked while tests run."""

import pytest
import torch
from jaxtyping import TypeCheckError

from foredrive.geometry.se3 import transform_points
from foredrive.scene import Trajectory


def test_a_wrong_shape_is_caught_in_a_function() -> None:
    with pytest.raises(TypeCheckError):
        transform_points(torch.eye(3), torch.zeros(5, 3))


def test_a_wrong_shape_is_caught_in_a_record() -> None:
    with pytest.raises(TypeCheckError):
        Trajectory(
            xy=torch.zeros(1, 6, 2),
            yaw=torch.zeros(1, 5),  # five headings for six positions
            valid=torch.ones(1, 6, dtype=torch.bool),
            log_prob=torch.zeros(1),
            dt_s=0.5,
        )
