"""Clips: what an agent may see."""

import dataclasses
from collections.abc import Callable

import pytest
import torch

from foredrive.errors import InputError
from foredrive.scene import Example, VoxelSpec

SPEC = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=1.0, shape_zyx=(2, 8, 8))


def test_observed_ends_at_now_and_hides_the_driven_future(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, past=2, future=3).clip
    clip.future.yaw[:] = 0.3
    seen = clip.observed()
    assert clip.now == 2
    assert seen.t_s[0].tolist() == [-1.0, -0.5, 0.0]
    assert seen.images.shape[1] == seen.rig.K.shape[1] == seen.boxes.centre.shape[1] == 3
    assert not seen.future.valid.any()
    assert not seen.future.xy.any()
    assert not seen.future.yaw.any()
    assert clip.future.valid.all()  # the original is as it was


def test_a_clip_through_some_cameras_has_theirs_in_that_order(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, past=1).clip
    first = clip.rig.K.new_tensor([1.0, 2.0])[:, None, None]
    clip = dataclasses.replace(clip, rig=dataclasses.replace(clip.rig, K=first * clip.rig.K))
    turned = clip.through([1, 0])
    assert turned.rig.names == ("camera_1", "camera_0")
    assert torch.equal(turned.rig.K, clip.rig.K.flip(2))
    assert torch.equal(turned.images, clip.images.flip(2))
    assert clip.through([1]).image_valid.shape[2] == 1


def test_a_batch_must_agree_on_where_now_is(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC).clip
    shifted = clip.t_s.clone()
    shifted[1] += 0.5
    with pytest.raises(InputError, match="one frame at t = 0"):
        _ = type(clip)(**{**vars(clip), "t_s": shifted}).now


def test_indexing_a_batch_indexes_every_tensor(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=3).clip
    one = clip[1]
    torch.testing.assert_close(one.images, clip.images[1])
    torch.testing.assert_close(one.rig.K, clip.rig.K[1])
    assert one.future.xy.shape == (1, 6, 2)


def test_voxel_centres_by_hand() -> None:
    centres = SPEC.centres_m()
    assert centres.shape == (2, 8, 8, 3)
    assert centres[1, 0, 7].tolist() == [3.5, -3.5, 0.5]
    assert SPEC.upper_m == (4.0, 4.0, 1.0)
