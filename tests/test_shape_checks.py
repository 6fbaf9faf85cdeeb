"""The types, shapes and dtypes in signatures are checked while tests run."""

import pytest
import torch
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import TypeCheckError
from shape_checks import CALLS

from foredrive.geometry.se3 import transform_points
from foredrive.scene import Trajectory, VoxelSpec
from foredrive.scene.conditions import find_conditions


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


def test_the_last_counted_call_is_still_checked() -> None:
    for _ in range(CALLS - 1):
        transform_points(torch.eye(4), torch.zeros(5, 3))
    with pytest.raises(TypeCheckError):
        transform_points(torch.eye(3), torch.zeros(5, 3))


def test_a_wrong_type_is_caught_without_shapes() -> None:
    with pytest.raises(BeartypeCallHintViolation):
        find_conditions(3)  # type: ignore[arg-type]
    with pytest.raises(BeartypeCallHintViolation):
        VoxelSpec(lower_m=(0.0, 0.0), voxel_m=1.0, shape_zyx=(2, 4, 4))  # type: ignore[arg-type]
