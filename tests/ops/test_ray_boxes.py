"""Rays through moving boxes: cases worked out by hand, gradients, the kernels beside the reference."""

import math
from collections.abc import Callable, Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.geometry.se3 import exp_se3
from foredrive.methods.reconstruction.tracks import ActorTracks, poses_at, states_at
from foredrive.ops import ray_boxes
from foredrive.ops.ray_boxes import Crossings, MovingBoxes, cross_boxes, key_poses

Cross = Callable[[Tensor, Tensor, Tensor, MovingBoxes], Crossings]


def by_reference(origin: Tensor, direction: Tensor, t_s: Tensor, boxes: MovingBoxes) -> Crossings:
    """Crossings in float64, for which there are no kernels."""
    doubled = boxes._replace(
        key_t_s=boxes.key_t_s.double(),
        T_scene_box=boxes.T_scene_box.double(),
        half_size_m=boxes.half_size_m.double(),
    )
    return cross_boxes(origin.double(), direction.double(), t_s.double(), doubled)


@pytest.fixture(params=["numba", "triton", "reference"])
def cross(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cross]:
    """One path of finding the crossings."""
    if request.param == "reference":
        yield by_reference
        return
    if request.param == "triton":
        pytest.importorskip("triton", reason="Triton is not installed")
        from foredrive.ops.ray_boxes_triton import crossing_pairs_triton

        monkeypatch.setattr(ray_boxes, "_crossing_pairs", crossing_pairs_triton)
    yield cross_boxes


def pose(x: float, y: float, yaw: float = 0.0) -> Tensor:
    return exp_se3(torch.tensor([0.0, 0, 0, 0, 0, yaw])) + torch.tensor(
        [[0.0] * 3 + [v] for v in (x, y, 0, 0)]
    )


def standing(*poses: Tensor) -> MovingBoxes:
    """Boxes of 4 × 2 × 2 m at one key time."""
    return MovingBoxes(
        torch.zeros(1),
        torch.stack(poses)[:, None],
        torch.tensor([[2.0, 1, 1]]).repeat(len(poses), 1),
        torch.ones(len(poses), 1, dtype=torch.bool),
    )


def forward(*y: float) -> tuple[Tensor, Tensor]:
    """Rays along x from (0, y, 0)."""
    origin = torch.tensor([[0.0, value, 0] for value in y])
    return origin, torch.tensor([[1.0, 0, 0]]).repeat(len(y), 1)


def test_two_boxes_one_behind_the_other(cross: Cross) -> None:
    """The first listed stands behind. A quarter of a turn makes it 2 m long along the ray."""
    boxes = standing(pose(20, 0, math.pi / 2), pose(10, 0.5))
    found = cross(*forward(0.0, 1.2, 5.0), torch.zeros(3), boxes)
    assert found.ray.tolist() == [0, 0, 1, 1]
    assert found.box.tolist() == [1, 0, 1, 0]
    torch.testing.assert_close(found.enter_m.float(), torch.tensor([8.0, 19, 8, 19]))
    torch.testing.assert_close(found.leave_m.float(), torch.tensor([12.0, 21, 12, 21]))
    torch.testing.assert_close(found.origin_box[:2].float(), torch.tensor([[-10, -0.5, 0], [0, 20.0, 0]]))
    torch.testing.assert_close(found.direction_box[1].float(), torch.tensor([0, -1.0, 0]))


def test_a_ray_that_starts_inside_and_one_that_looks_away(cross: Cross) -> None:
    origin = torch.tensor([[1.0, 0, 0], [5, 0, 0]])
    found = cross(origin, torch.tensor([[1.0, 0, 0]] * 2), torch.zeros(2), standing(pose(0, 0)))
    assert found.ray.tolist() == [0]
    assert (found.enter_m.item(), found.leave_m.item()) == (0, 1)


def test_each_ray_meets_the_box_where_it_is_at_the_time_of_the_ray(cross: Cross) -> None:
    """A box drives across at 10 m/s, and is there from the second key time on."""
    keys = torch.tensor([0.0, 1.0, 2.0])
    path = torch.stack([pose(10, -10), pose(10, 0), pose(10, 10)])[None]
    boxes = MovingBoxes(keys, path, torch.tensor([[1.0, 1, 1]]), torch.tensor([[False, True, True]]))
    origin, direction = forward(0.0, 5.0, 5.0, 0.0, 12.0)
    found = cross(origin, direction, torch.tensor([1.05, 1.05, 1.5, 0.95, 2.2]), boxes)
    assert found.ray.tolist() == [0, 2, 4]  # present at 0.95 s: only at one of the two key times around
    torch.testing.assert_close(found.origin_box[0].float(), torch.tensor([-10, -0.5, 0]))


def moving_case(seed: int, rays: int, count: int, keys: int) -> tuple[Tensor, Tensor, Tensor, MovingBoxes]:
    rng = torch.Generator().manual_seed(seed)
    T = exp_se3(torch.randn(count, 1, 6, generator=rng) * torch.tensor([8.0, 8, 1, 0.1, 0.1, 2]))
    steps = torch.randn(count, keys, 6, generator=rng) * torch.tensor([0.5, 0.1, 0.05, 0.02, 0.02, 0.2])
    direction = torch.randn(rays, 3, generator=rng) * torch.tensor([1.0, 1, 0.1])
    boxes = MovingBoxes(
        key_t_s=torch.arange(keys) * 0.1,
        T_scene_box=T @ exp_se3(steps),
        half_size_m=0.3 + 2 * torch.rand(count, 3, generator=rng),
        present=torch.rand(count, keys, generator=rng) > 0.2,
    )
    origin = torch.randn(rays, 3, generator=rng)
    t_s = 0.1 * (keys + 1) * torch.rand(rays, generator=rng) - 0.1
    return origin, torch.nn.functional.normalize(direction, dim=-1), t_s, boxes


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**16), rays=st.integers(1, 700), count=st.integers(0, 7), keys=st.integers(1, 4))
def test_the_kernel_is_the_reference(seed: int, rays: int, count: int, keys: int) -> None:
    compare(cross_boxes, moving_case(seed, rays, count, keys))


def test_triton_is_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("triton", reason="Triton is not installed")
    from foredrive.ops.ray_boxes_triton import crossing_pairs_triton

    monkeypatch.setattr(ray_boxes, "_crossing_pairs", crossing_pairs_triton)
    compare(cross_boxes, moving_case(1, 100, 5, 3))


def compare(cross: Cross, case: tuple[Tensor, Tensor, Tensor, MovingBoxes]) -> None:
    """Pairs, distances, local rays and the gradients to rays and poses. Grazing hits may differ."""
    results = []
    for dtype in (torch.float32, torch.float64):
        origin, direction, t_s, boxes = case
        leaves = [x.to(dtype).requires_grad_() for x in (origin, direction, boxes.T_scene_box)]
        held = boxes._replace(T_scene_box=leaves[2])
        found = cross(leaves[0], leaves[1], t_s.to(dtype), held)
        thick = (found.leave_m - found.enter_m) > 1e-2
        if not bool(thick.any()):
            results.append([found.ray[thick]])
            continue
        outputs = [found.enter_m, found.leave_m, found.origin_box, found.direction_box]
        loss = sum((out[thick] ** 2).sum() for out in outputs)
        assert isinstance(loss, Tensor)
        outputs = [out.detach()[thick] for out in outputs]
        results.append([found.ray[thick], found.box[thick], *outputs, *torch.autograd.grad(loss, leaves)])
    for fast, exact in zip(*results, strict=True):
        if fast.dtype == torch.int64:
            assert torch.equal(fast, exact)
        else:
            scale = float(exact.abs().max())
            torch.testing.assert_close(fast.double(), exact, rtol=1e-3, atol=1e-3 * max(scale, 1))


def test_gradients_of_distances_and_local_rays() -> None:
    origin, direction, t_s, boxes = moving_case(3, 40, 5, 2)

    def op(origin: Tensor, direction: Tensor, T: Tensor) -> tuple[Tensor, ...]:
        return tuple(cross_boxes(origin, direction, t_s.double(), boxes._replace(T_scene_box=T))[2:])

    leaves = [x.double().requires_grad_() for x in (origin, direction, boxes.T_scene_box)]
    assert len(op(*leaves)[0]) > 2
    assert torch.autograd.gradcheck(op, leaves)


def test_boxes_move_as_tracks_do() -> None:
    _, _, _, boxes = moving_case(4, 1, 3, 3)
    for t_s in (-0.03, 0.04, 0.13, 0.25):
        T, _, _ = poses_at(boxes.key_t_s, boxes.T_scene_box, t_s)
        centre = T[:, :3, 3]
        there = boxes._replace(present=torch.ones_like(boxes.present))
        found = cross_boxes(centre, T[:, :3, 0], torch.full((3,), t_s), there)
        for box in range(3):  # the ray from each centre along its own x axis
            own = (found.ray == box) & (found.box == box)
            torch.testing.assert_close(found.origin_box[own], torch.zeros(1, 3), atol=1e-5, rtol=0)
            torch.testing.assert_close(
                found.direction_box[own], torch.tensor([[1.0, 0, 0]]), atol=1e-5, rtol=0
            )


def test_boxes_are_there_as_long_as_tracks_are() -> None:
    """At most one step beyond the key times; around a single key time for the given time."""
    origin, direction = forward(0.0, 0.0, 0.0, 0.0)
    still, size = pose(10, 0, 0.3), torch.tensor([[2.0, 1, 1]])
    there = torch.ones(1, 2, dtype=torch.bool)
    moving = MovingBoxes(torch.tensor([1.0, 1.5]), torch.stack([still, still])[None], size, there)
    t_s = torch.tensor([0.45, 0.55, 1.95, 2.05])
    assert cross_boxes(origin, direction, t_s, moving).ray.tolist() == [1, 2]
    single = MovingBoxes(torch.ones(1), still[None, None], size, there[:, :1], hold_s=0.5)
    assert cross_boxes(origin, direction, t_s, single).ray.tolist() == [1]
    tracks = tracks_of(moving), tracks_of(single)
    present = [[bool(states_at(held, t).present) for t in t_s.tolist()] for held in tracks]
    assert present == [[False, True, True, False], [False, True, False, False]]


def tracks_of(boxes: MovingBoxes) -> ActorTracks:
    whole = torch.zeros(1, dtype=torch.int64)
    return ActorTracks(whole, whole, 2 * boxes.half_size_m, boxes.key_t_s, boxes.T_scene_box, boxes.present)


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    origin, direction, t_s, boxes = moving_case(5, 20_000, 9, 4)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            leaves = [x.clone().requires_grad_() for x in (origin, direction, boxes.T_scene_box)]
            found = cross_boxes(leaves[0], leaves[1], t_s, boxes._replace(T_scene_box=leaves[2]))
            loss = found.origin_box.square().sum() + found.direction_box.pow(3).sum()
            results.append([*(x.detach() for x in found), *torch.autograd.grad(loss, leaves)])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_the_kernels_read_contiguous_memory() -> None:
    origin, direction, t_s, boxes = moving_case(6, 50, 3, 3)
    turned = boxes._replace(T_scene_box=boxes.T_scene_box.transpose(0, 1).contiguous().transpose(0, 1))
    wide = torch.stack([direction, direction], dim=1)[:, 0]
    expected = cross_boxes(*moving_case(6, 50, 3, 3))
    assert torch.equal(cross_boxes(origin, wide, t_s, turned).enter_m, expected.enter_m)
    plain = (origin, direction, torch.zeros(50, dtype=torch.int64), t_s)
    assert all(tensor.is_contiguous() for tensor in key_poses(*plain, turned, boxes.present[:, 1:]))
