"""Deformable lifting: hand-computed cases, the reference's gradients, the fast paths against it."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.ops.lifting import join_levels, lift, lift_reference

Parity = Callable[..., None]
Op = Callable[..., Tensor]


@pytest.fixture(scope="session", params=["numba", "triton"])
def op(request: pytest.FixtureRequest, triton_op: Callable[[str, str], Op]) -> Op:
    """The fast paths."""
    return lift if request.param == "numba" else joined(triton_op("lifting_triton", "lift_triton"))


def joined(op: Op) -> Op:
    """The op for feature maps that are not joined yet."""

    def lifted(values: Sequence[Tensor], *others: Tensor) -> Tensor:
        maps, sizes = join_levels(values)
        return op(maps, tuple(sizes), *others)

    return lifted


def flat_lift(op: Callable[..., Tensor], uv: Tensor, visible: Tensor) -> Callable[..., Tensor]:
    """`op` as a function of what it is differentiated by: offsets, weights, then the values."""
    return lambda offsets, weights, *values: op(values, uv, visible, offsets, weights)


def case(
    seed: int,
    *,
    b: int = 2,
    cameras: int = 3,
    queries: int = 37,
    heads: int = 2,
    width: int = 8,
    points: int = 3,
    sizes: tuple[tuple[int, int], ...] = ((4, 6), (2, 2)),
    seen: float = 0.4,
) -> tuple[list[Tensor], Tensor, Tensor]:
    """Offsets, weights and values; uv; visible. No point comes near a kink, where gradients are undefined."""
    rng = torch.Generator().manual_seed(seed)
    shape = (b, queries, heads, len(sizes), points)
    whole = torch.randint(-4, 5, (*shape, 2), generator=rng)
    offsets = whole + 0.55 + 0.9 * torch.rand(*shape, 2, generator=rng)
    weights = torch.randn(shape, generator=rng)
    values = [torch.randn(b, cameras, h, w, heads * width, generator=rng) for h, w in sizes]
    uv = torch.randint(0, 3, (b, cameras, queries, 2), generator=rng) / 2
    return [offsets, weights, *values], uv, torch.rand(b, cameras, queries, generator=rng) < seen


ONE_MAP = torch.tensor([[1.0, 2.0], [3.0, 4.0]])


def read_one(op: Op, u: float, v: float, dx: float = 0.0, dy: float = 0.0, weight: float = 1.0) -> float:
    """What a single query, head and point reads from the 2×2 map [[1, 2], [3, 4]]."""
    out = op(
        [ONE_MAP.view(1, 1, 2, 2, 1)],
        torch.tensor([u, v]).view(1, 1, 1, 2),
        torch.ones(1, 1, 1, dtype=torch.bool),
        torch.tensor([dx, dy]).view(1, 1, 1, 1, 1, 2),
        torch.tensor(weight).view(1, 1, 1, 1, 1),
    )
    return out.item()


def test_bilinear_reading_by_hand(op: Op) -> None:
    assert read_one(op, 0.25, 0.25) == 1  # the centre of the top left pixel
    assert read_one(op, 0.75, 0.25) == 2
    assert read_one(op, 0.25, 0.75) == 3
    assert read_one(op, 0.5, 0.5) == 2.5
    assert read_one(op, 0.5, 0.5, weight=0.5) == 1.25
    assert read_one(op, 0.25, 0.25, dx=1.0, dy=1.0) == 4  # offsets are in pixels
    assert read_one(op, 0.0, 0.25) == 0.5  # half of what is read there lies outside
    assert read_one(op, 0.0, 0.0) == 0.25
    assert read_one(op, 0.25, 0.25, dx=-1.0) == 0


def test_cameras_that_see_the_query_are_averaged(op: Op) -> None:
    values = torch.stack([torch.full((2, 2, 1), v) for v in (1.0, 4.0, 100.0)])[None]
    visible = torch.tensor([[[True, True, False, False], [True, False, False, True], [False] * 4]])
    out = op(
        [values],
        torch.full((1, 3, 4, 2), 0.5),
        visible,
        torch.zeros(1, 4, 1, 1, 1, 2),
        torch.ones(1, 4, 1, 1, 1),
    )
    assert out.flatten().tolist() == [2.5, 1.0, 0.0, 4.0]


def test_every_batch_item_has_its_own_visibility(op: Op) -> None:
    visible = torch.tensor([[[True, False]], [[False, True]]])
    out = op(
        [torch.ones(2, 1, 2, 2, 1)],
        torch.full((2, 1, 2, 2), 0.5),
        visible,
        torch.zeros(2, 2, 1, 1, 1, 2),
        torch.ones(2, 2, 1, 1, 1),
    )
    assert out[..., 0].tolist() == [[1, 0], [0, 1]]


def test_heads_read_their_own_channels_and_levels_their_own_pixels(op: Op) -> None:
    fine = torch.arange(4.0).view(1, 1, 1, 1, 4).expand(1, 1, 2, 4, 4)  # channel c holds c
    coarse = 10 + torch.arange(2.0).view(1, 1, 1, 2, 1).expand(1, 1, 1, 2, 4)  # column x holds 10 + x
    weights = torch.tensor([[1.0, 0.0], [0.0, 1.0]]).view(1, 1, 2, 2, 1)  # head 0: fine, head 1: coarse
    out = op(
        [fine, coarse],
        torch.tensor([0.25, 0.5]).view(1, 1, 1, 2),
        torch.ones(1, 1, 1, dtype=torch.bool),
        torch.tensor([1.0, 0.0]).expand(1, 1, 2, 2, 1, 2),  # one pixel to the right, whatever the level
        weights,
    )
    assert out.flatten().tolist() == [0, 1, 11, 11]


def test_gradients_of_the_reference() -> None:
    inputs, uv, visible = case(0, b=2, cameras=2, queries=3, width=2, points=2, sizes=((2, 4), (2, 2)))
    doubles = [x.double().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(flat_lift(lift, uv.double(), visible), doubles)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**16),
    b=st.integers(1, 3),
    cameras=st.integers(1, 4),
    queries=st.integers(1, 90),
    heads=st.integers(1, 4),
    width=st.sampled_from([1, 3, 8, 12, 16]),
    points=st.integers(1, 9),
    halves=st.lists(st.tuples(st.integers(1, 4), st.integers(1, 4)), min_size=1, max_size=4),
    seen=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_the_fast_path_is_the_reference(
    parity: Parity, seed: int, halves: list[tuple[int, int]], **shape: int | float
) -> None:
    inputs, uv, visible = case(seed, sizes=tuple((2 * h, 2 * w) for h, w in halves), **shape)
    parity(flat_lift(lift, uv, visible), flat_lift(lift_reference, uv, visible), inputs)


@pytest.mark.parametrize(
    "shape",
    [
        {"queries": 9},
        {"b": 1, "cameras": 1, "queries": 5, "heads": 3, "width": 5, "points": 2, "sizes": ((1, 3),)},
        {"queries": 3, "heads": 1, "width": 40, "points": 1, "seen": 1.0},
        {"b": 1, "queries": 2, "points": 19, "sizes": ((3, 5),)},
    ],
)
def test_triton_is_the_reference(
    parity: Parity, triton_op: Callable[[str, str], Op], shape: dict[str, Any]
) -> None:
    inputs, uv, visible = case(3, **shape)
    fast = joined(triton_op("lifting_triton", "lift_triton"))
    parity(flat_lift(fast, uv, visible), flat_lift(lift_reference, uv, visible), inputs)


def test_parity_where_threads_share_the_work(parity: Parity) -> None:
    inputs, _, visible = case(3, queries=3000, heads=4, points=4, sizes=((8, 12), (5, 7), (3, 3)))
    uv = torch.rand(2, 3, 3000, 2, generator=torch.Generator().manual_seed(4)) * 1.2 - 0.1
    parity(flat_lift(lift, uv, visible), flat_lift(lift_reference, uv, visible), inputs)


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    inputs, uv, visible = case(5, queries=2000, heads=4)
    threads = torch.get_num_threads()
    results = []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            leaves = [x.clone().requires_grad_() for x in inputs]
            out = flat_lift(lift, uv, visible)(*leaves)
            results.append([out.detach(), *torch.autograd.grad(out.square().sum(), leaves)])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("wanted", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 1), (0, 0, 0, 1), (0, 0, 0, 0)])
def test_gradients_of_some_inputs_only(op: Op, parity: Parity, wanted: tuple[int, ...]) -> None:
    inputs, uv, visible = case(1, queries=9)
    parity(
        flat_lift(op, uv, visible),
        flat_lift(lift_reference, uv, visible),
        inputs,
        [bool(w) for w in wanted],
    )


def test_inputs_may_lie_in_memory_as_they_like(op: Op, parity: Parity) -> None:
    (offsets, weights, *values), uv, visible = case(2, queries=9)

    def shuffled(lift: Op) -> Op:
        def run(offsets: Tensor, weights: Tensor, *values: Tensor) -> Tensor:
            turned = [v.permute(0, 1, 4, 2, 3).contiguous().permute(0, 1, 3, 4, 2) for v in values]
            back = offsets.flip(1).transpose(0, 1).contiguous().transpose(0, 1)
            return lift(turned, uv.flip(2), visible.flip(2), back, weights.flip(1))

        return run

    parity(shuffled(op), shuffled(lift_reference), [offsets, weights, *values])
    parity(shuffled(op), lambda *args: flat_lift(op, uv, visible)(*args).flip(1), [offsets, weights, *values])


@pytest.mark.parametrize("empty", [{"b": 0}, {"cameras": 0}, {"queries": 0}, {"seen": 0.0}])
def test_nothing_to_see_reads_zero(op: Op, empty: dict[str, int]) -> None:
    inputs, uv, visible = case(0, **{"queries": 9} | empty)
    leaves = [x.requires_grad_() for x in inputs]
    out = flat_lift(op, uv, visible)(*leaves)
    assert out.shape == (len(visible), visible.shape[2], 16)
    assert not out.any()
    assert not any(grad.any() for grad in torch.autograd.grad(out.sum(), leaves))


@pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")  # interpreted
def test_far_away_reads_zero_and_never_outside_the_memory(
    op: Op, guard: Callable[[Tensor], Tensor], wild: Tensor
) -> None:
    places = torch.cartesian_prod(wild, wild)  # [Q 2]
    visible = torch.ones(1, 1, len(places), dtype=torch.bool)
    offsets = places.view(1, -1, 1, 1, 1, 2).clone().requires_grad_()
    weights = torch.ones(1, len(places), 1, 1, 1, requires_grad=True)
    values = guard(torch.ones(1, 1, 3, 5, 9)).requires_grad_()
    uv = torch.zeros(1, 1, len(places), 2)
    for given_uv, given_offsets in (
        (uv, offsets),
        (places[None, None], 0 * weights[..., None].expand_as(offsets)),
    ):
        out = op([values], given_uv, visible, given_offsets, weights)
        assert torch.equal(out, torch.zeros_like(out))
        assert not any(g.any() for g in torch.autograd.grad(out.sum(), [values, weights]))


def test_the_border_reads_nothing_outside_the_memory(op: Op, guard: Callable[[Tensor], Tensor]) -> None:
    inputs, uv, visible = case(6, heads=1, width=9, sizes=((4, 6),), queries=100)
    offsets, weights, values = inputs
    expected = op([values], uv, visible, offsets, weights)
    out = op([guard(values)], uv, visible, offsets, weights)
    assert torch.equal(out, expected)


def test_nan_goes_to_the_query_it_belongs_to_and_no_further(op: Op) -> None:
    inputs, uv, visible = case(0, b=1, queries=9, seen=0.9)
    visible[:, :, :3] = True
    visible[:, :, 3] = False
    offsets, weights, *values = inputs
    offsets[0, 0, 0, 0, 0, 1] = torch.nan  # one head's point
    uv[0, 1, 1] = torch.nan
    weights[0, 2, 1, 0, 0] = torch.nan
    offsets[0, 3], uv[0, :, 3] = torch.nan, torch.nan  # nobody sees this one
    for path in (op, lift_reference):
        out = path(values, uv, visible, offsets, weights)[0].unflatten(-1, (2, 8))
        nan = out.isnan()
        assert nan[0].all(-1).tolist() == [True, False]
        assert nan[1].all()
        assert nan[2].all(-1).tolist() == [False, True]
        assert not nan[3:].any()


def test_half_precision_is_computed_in_full_precision(op: Op) -> None:
    inputs, uv, visible = case(0, queries=9)
    halves = [x.bfloat16().requires_grad_() for x in inputs]
    expected = flat_lift(op, uv, visible)(*[x.float() for x in halves])
    with torch.autocast("cpu", torch.bfloat16):
        out = flat_lift(op, uv, visible)(*halves)
        reference = flat_lift(lift_reference, uv, visible)(*halves)
    assert out.dtype == reference.dtype == torch.float32
    assert torch.equal(out, expected)
    torch.testing.assert_close(out, reference, rtol=1e-4, atol=1e-4)
    assert all(g.dtype == torch.bfloat16 for g in torch.autograd.grad(out.sum(), halves))


def test_more_points_than_a_block_go_to_the_reference() -> None:
    inputs, uv, visible = case(0, points=150, queries=3)
    out, expected = (flat_lift(op, uv, visible)(*inputs) for op in (lift, lift_reference))
    assert torch.equal(out, expected)


def test_shapes_that_do_not_fit_are_refused() -> None:
    (offsets, weights, *values), uv, visible = case(0)
    with pytest.raises(ValueError, match="multiple of H"):
        lift([v[..., :15] for v in values], uv, visible, offsets, weights)
    with pytest.raises(ValueError, match="do not fit"):
        lift(values[:1], uv, visible, offsets, weights)
