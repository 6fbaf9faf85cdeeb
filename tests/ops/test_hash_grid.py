"""Hash grids: cases worked out by hand, the reference's gradients, the kernels beside the reference."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.ops.hash_grid import Level, grid_levels, read_hash_grid, read_hash_grid_reference

Op = Callable[..., Tensor]


@pytest.fixture(scope="session", params=["numba", "triton", "reference"])
def read(request: pytest.FixtureRequest, triton_op: Callable[[str, str], Op]) -> Op:
    """One path of reading a grid."""
    if request.param == "numba":
        return read_hash_grid
    if request.param == "reference":
        return read_hash_grid_reference
    return triton_op("hash_grid_triton", "read_hash_grid_triton")


def case(seed: int, levels: tuple[Level, ...], features: int, count: int, actors: int = 1) -> dict[str, Any]:
    """A table, points of which a few lie outside, footprints around the cells' sizes, and owners."""
    rng = torch.Generator().manual_seed(seed)
    points = 1.4 * torch.rand(count, 3, generator=rng) - 0.2
    finest = levels[-1].cells  # keep away from the borders of cells, where gradients jump
    points = ((points * finest).floor() + 0.1 + 0.8 * torch.rand(count, 3, generator=rng)) / finest
    return {
        "table": torch.randn(levels[-1].first_row + levels[-1].rows, features, generator=rng),
        "points": points,
        "footprint": 2 * torch.rand(count, generator=rng) / levels[0].cells,
        "actor": torch.randint(actors, (count,), generator=rng) if actors > 1 else None,
    }


def powers(levels: int, coarsest: int, log2_rows: int, actors: int = 1) -> tuple[Level, ...]:
    """Levels of which each cell is divided by whole numbers in the next."""
    return grid_levels(levels, coarsest, coarsest * 2 ** (levels - 1), log2_rows, actors)


def test_levels_grow_by_a_constant_factor_and_are_dense_while_they_fit() -> None:
    levels = grid_levels(4, 2, 16, 7, actors=2)
    assert [level.cells for level in levels] == [2, 4, 8, 16]
    assert [level.rows for level in levels] == [54, 128, 128, 128]  # 2 · 3³, then 2⁷
    assert [level.first_row for level in levels] == [0, 54, 182, 310]
    assert [level.dense for level in levels] == [True, False, False, False]
    assert [level.cells for level in grid_levels(3, 16, 64, 19)] == [16, 32, 64]
    assert grid_levels(1, 5, 99, 19)[0].cells == 5


def test_a_dense_cell_by_hand(read: Op) -> None:
    """One cell whose vertex (x, y, z) holds x + 10 y + 100 z: the interpolation is that function."""
    table = torch.tensor([[x + 10.0 * y + 100 * z] for z in range(2) for y in range(2) for x in range(2)])
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.25, 0.5, 0.75], [1, 1, 1], [2, -3, 0.5]])
    found = read(table, points, grid_levels(1, 1, 1, 3))
    torch.testing.assert_close(found, torch.tensor([[0, 1, 0.25 + 5 + 75, 111, 1 + 50]]))


def test_a_hashed_vertex_by_hand(read: Op) -> None:
    """At the vertex (3, 5, 7) of actor 2 the hash of these four numbers is read."""
    level = Level(cells=8, first_row=4, rows=16, dense=False)
    table = torch.arange(20.0)[:, None]
    row = (3 ^ (5 * 2654435761) ^ (7 * 805459861) ^ (2 * 3674653429)) % 16
    found = read(table, torch.tensor([[3.0, 5, 7]]) / 8, (level,), None, torch.tensor([2]))
    assert found.item() == 4 + row


def test_a_level_finer_than_the_footprint_fades(read: Op) -> None:
    """1 / (2 · cells · footprint): the level of 4 cells keeps 1, that of 8 cells half of its features."""
    levels = grid_levels(2, 4, 8, 10)
    table = torch.ones(levels[-1].first_row + levels[-1].rows, 1)
    found = read(table, torch.full((1, 3), 0.3), levels, torch.tensor([1 / 8]))
    torch.testing.assert_close(found[:, 0], torch.tensor([1.0, 0.5]))


def test_gradients_of_the_reference() -> None:
    levels = powers(2, 2, 5, actors=2)
    given = case(0, levels, 2, 6, actors=2)
    leaves = [given[name].double().requires_grad_() for name in ("table", "points")]
    footprint, actor = given["footprint"].double(), given["actor"]
    assert torch.autograd.gradcheck(
        lambda table, points: read_hash_grid(table, points, levels, footprint, actor), leaves
    )


def against_double(read: Op, given: dict[str, Any], levels: tuple[Level, ...]) -> None:
    """Value and gradients in float32 agree with the reference in float64."""
    results = []
    for op, dtype in ((read, torch.float32), (read_hash_grid_reference, torch.float64)):
        table, points = (given[name].to(dtype).requires_grad_() for name in ("table", "points"))
        footprint = None if given["footprint"] is None else given["footprint"].to(dtype)
        out = op(table, points, levels, footprint, given["actor"])
        upstream = torch.randn(out.shape, generator=torch.Generator().manual_seed(7))
        grads = torch.autograd.grad(out, [table, points], upstream.to(dtype))
        results.append([out.detach(), *grads])
    for fast, exact in zip(*results, strict=True):
        scale = max(float(exact.abs().max()), 1e-3)
        torch.testing.assert_close(fast.double(), exact, rtol=1e-4, atol=2e-5 * scale)


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**16),
    number=st.integers(1, 4),
    coarsest=st.integers(1, 9),
    log2_rows=st.integers(3, 9),
    features=st.sampled_from([1, 2, 3, 4, 8]),
    count=st.integers(1, 700),
    actors=st.integers(1, 5),
    footprints=st.booleans(),
)
def test_the_kernel_is_the_reference_in_float64(
    seed: int,
    number: int,
    coarsest: int,
    log2_rows: int,
    features: int,
    count: int,
    actors: int,
    footprints: bool,
) -> None:
    levels = powers(number, coarsest, log2_rows, actors)
    given = case(seed, levels, features, count, actors)
    if not footprints:
        given["footprint"] = None
    against_double(read_hash_grid, given, levels)


@pytest.mark.parametrize(("features", "actors", "footprints"), [(1, 1, False), (2, 3, True), (4, 1, True)])
def test_triton_is_the_reference_in_float64(
    triton_op: Callable[[str, str], Op], features: int, actors: int, footprints: bool
) -> None:
    read = triton_op("hash_grid_triton", "read_hash_grid_triton")
    levels = powers(3, 2, 6, actors)
    given = case(5, levels, features, 150, actors)
    if not footprints:
        given["footprint"] = None
    against_double(read, given, levels)


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    levels = powers(5, 4, 9)
    given = case(1, levels, 2, 20_000)
    threads, results = torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            table, points = (given[name].clone().requires_grad_() for name in ("table", "points"))
            out = read_hash_grid(table, points, levels, given["footprint"])
            results.append([out.detach(), *torch.autograd.grad(out.square().sum(), [table, points])])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("wanted", [(True, False), (False, True)])
def test_gradients_of_some_inputs_only(read: Op, wanted: tuple[bool, bool]) -> None:
    levels = powers(2, 3, 6)
    given = case(2, levels, 2, 40)
    leaves = [given[n].clone().requires_grad_(w) for n, w in zip(("table", "points"), wanted, strict=True)]
    both = [given[n].clone().requires_grad_() for n in ("table", "points")]
    read(*leaves, levels).square().sum().backward()
    read_hash_grid_reference(*both, levels).square().sum().backward()
    for leaf, other, flag in zip(leaves, both, wanted, strict=True):
        assert (leaf.grad is not None) == flag
        if flag:
            torch.testing.assert_close(leaf.grad, other.grad, rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")  # interpreted
def test_nan_and_far_away_points_read_nothing_outside_of_the_table(
    read: Op, guard: Callable[[Tensor], Tensor], wild: Tensor
) -> None:
    levels = powers(2, 3, 6)
    table = guard(case(3, levels, 2, 1)["table"])
    places = torch.cartesian_prod(wild, wild, torch.tensor([0.5])).requires_grad_()
    found = read(table, places, levels)
    assert found.isfinite().all()
    assert torch.autograd.grad(found.sum(), places)[0][:, :2].abs().max() == 0
    odd = torch.tensor([[0.5, torch.nan, 0.5], [0.5, 0.5, 0.5]])
    assert read(table, odd, levels).isnan().all(0).tolist() == [True, False]


def test_nothing_to_read(read: Op) -> None:
    levels = powers(2, 3, 6)
    table = case(0, levels, 2, 1)["table"].requires_grad_()
    out = read(table, torch.zeros(0, 3), levels)
    assert out.shape == (4, 0)
    assert not torch.autograd.grad(out.sum(), table)[0].any()


def test_a_table_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="need 27 rows, the table has 26"):
        read_hash_grid(torch.zeros(26, 2), torch.zeros(1, 3), grid_levels(1, 2, 2, 5))
