"""Pillars of any number of points, attention within windows, and the vector that comes of them."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig, PillarGrid, PointCloud
from foredrive.methods.lidarclip.attention_pool import AttentionPool
from foredrive.methods.lidarclip.encoder import WindowAttention, Windows
from foredrive.methods.lidarclip.pillars import PillarEncoder, pillar_max
from foredrive.scene import LidarSweep

GRID = PillarGrid()


def cloud(seed: int, count: int = 300, items: int = 1) -> PointCloud:
    """Points all over the grid and beyond."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 4, generator=generator) * torch.tensor([44.0, 44.0, 7.0, 1.0])
    points -= torch.tensor([2.0, 22.0, 1.5, 0.0])
    return PointCloud(points, torch.randint(items, (count,), generator=generator))


@pytest.fixture(scope="module")
def encoder() -> LidarEncoder:
    torch.manual_seed(0)
    return LidarEncoder(LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=2, grid=GRID), dim=6).eval()


@pytest.fixture(scope="module")
def attention() -> WindowAttention:
    torch.manual_seed(0)
    return WindowAttention(layers=2, width=8, heads=2, hidden=8, side=4).eval()


@given(st.integers(0, 1000), st.integers(1, 60), st.integers(1, 9))
@settings(max_examples=25, deadline=None)
def test_the_maximum_over_pillars_is_that_of_a_loop(seed: int, points: int, pillars: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(points + pillars, 3, generator=generator)
    every = torch.arange(pillars)
    pillar = torch.cat([every, torch.randint(pillars, (points,), generator=generator)])
    looped = torch.stack([features[pillar == n].amax(0) for n in range(pillars)])
    torch.testing.assert_close(pillar_max(features, pillar, pillars), looped, rtol=0, atol=0)


def test_pillars_are_those_of_a_loop_over_cells() -> None:
    torch.manual_seed(0)
    made = cloud(3, items=2)
    encoder = PillarEncoder(GRID, (8, 4))
    found = encoder(made, 2)
    expected: dict[tuple[int, int, int], list[torch.Tensor]] = {}
    for point, item in zip(made.points, made.item.tolist(), strict=True):
        x, y, z = point[:3].tolist()
        if 0 <= x < 40 and -20 <= y < 20 and -1 <= z < 5:
            expected.setdefault((item, int((y + 20) // 0.5), int(x // 0.5)), []).append(point)
    cells = [(i, *cell) for i, cell in zip(found.item.tolist(), found.cell_yx.tolist(), strict=True)]
    assert cells == sorted(expected)
    for row, cell in enumerate(cells):
        alone = encoder(
            PointCloud(torch.stack(expected[cell]), torch.zeros(len(expected[cell]), dtype=torch.int64)), 1
        )
        torch.testing.assert_close(alone.features[0], found.features[row], atol=1e-5, rtol=1e-5)


def test_a_pillar_is_the_same_wherever_it_is() -> None:
    torch.manual_seed(0)
    encoder = PillarEncoder(GRID, (8, 4))
    made = cloud(1)
    near = made.points[(made.points[:, 0] < 20) & (made.points[:, 0] > 0)]
    item = torch.zeros(len(near), dtype=torch.int64)
    here = encoder(PointCloud(near, item), 1)
    there = encoder(PointCloud(near + torch.tensor([8.0, 0.0, 0.0, 0.0]), item), 1)
    torch.testing.assert_close(
        there.cell_yx - here.cell_yx, torch.tensor([[0, 16]]).expand(len(here.item), 2)
    )
    torch.testing.assert_close(there.features, here.features, atol=1e-4, rtol=1e-4)


def test_windows_hold_every_pillar_once_and_no_strangers() -> None:
    cells = torch.tensor([[y, x] for y in range(9) for x in range(9) if (y + x) % 3])
    cell_yx, item = cells.repeat(2, 1), torch.arange(2).repeat_interleave(len(cells))
    for shift in (0, 2):
        windows = Windows.cut(cell_yx, item, 4, shift)
        assert sorted(windows.order.tolist()) == list(range(len(item)))
        held = windows.order.split(windows.counts.tolist())
        for mine in held:
            assert len(((cell_yx[mine] + shift) // 4).unique(dim=0)) == 1
            assert len(item[mine].unique()) == 1
        assert len(held) == 2 * len(((cell_yx + shift) // 4).unique(dim=0))
        inside = (cell_yx + shift) % 4
        assert windows.place.tolist() == (inside[:, 0] * 4 + inside[:, 1]).tolist()


def test_windows_of_unequal_size_attend_as_a_dense_mask_says(attention: WindowAttention) -> None:
    torch.manual_seed(1)
    cell_yx = torch.rand(12, 12).lt(0.4).nonzero()
    item = torch.zeros(len(cell_yx), dtype=torch.int64)
    features = torch.randn(len(cell_yx), 8)
    expected = features
    for number, block in enumerate(attention.blocks):
        moved = cell_yx + (2 if number % 2 else 0)
        same = ((moved // 4)[:, None] == (moved // 4)[None]).all(-1)
        normed = block.norm(expected)
        inside = moved % 4
        query_key = block.to_query_key(normed + block.place[inside[:, 0] * 4 + inside[:, 1]])
        query, key, value = (
            part.view(-1, 2, 4).transpose(0, 1) for part in (*query_key.chunk(2, -1), block.to_value(normed))
        )
        weights = (query @ key.mT / 2).masked_fill(~same, -torch.inf).softmax(-1)
        expected = expected + block.merge((weights @ value).transpose(0, 1).flatten(1))
        expected = expected + block.feed(expected)
    torch.testing.assert_close(attention(features, cell_yx, item), expected, atol=1e-5, rtol=1e-4)


def test_a_sweep_is_embedded_alike_while_nothing_learns() -> None:
    torch.manual_seed(0)
    encoder = LidarEncoder(
        LidarEncoderConfig(width=32, heads=2, hidden=16, blocks=2, grid=GRID), dim=6
    ).eval()
    made = cloud(9, count=2000, items=2)
    learning = encoder(made, 2)
    with torch.no_grad():
        torch.testing.assert_close(encoder(made, 2), learning, atol=1e-5, rtol=1e-4)


def test_a_scene_moved_by_a_whole_window_is_attended_to_alike(attention: WindowAttention) -> None:
    torch.manual_seed(2)
    cell_yx = torch.rand(12, 12).lt(0.4).nonzero()
    item, features = torch.zeros(len(cell_yx), dtype=torch.int64), torch.randn(len(cell_yx), 8)
    here = attention(features, cell_yx, item)
    there = attention(features, cell_yx + torch.tensor([4, 8]), item)
    torch.testing.assert_close(there, here, atol=1e-5, rtol=1e-5)
    askew = attention(features, cell_yx + torch.tensor([1, 0]), item)
    assert not torch.allclose(askew, here, atol=1e-3)


def test_a_block_of_two_layers_is_two_blocks_of_one() -> None:
    small = {"width": 16, "heads": 2, "hidden": 16}
    torch.manual_seed(0)
    full = LidarEncoder(LidarEncoderConfig(**small, blocks=2, block_layers=2), dim=6).eval()
    torch.manual_seed(0)
    flat = LidarEncoder(LidarEncoderConfig(**small, blocks=4), dim=6).eval()
    assert len(full.attention.blocks) == 4
    made = cloud(3, items=2)
    torch.testing.assert_close(full(made, 2), flat(made, 2), rtol=0, atol=0)


def test_every_other_layer_looks_across_the_borders_of_the_first(attention: WindowAttention) -> None:
    features = torch.zeros(2, 8, requires_grad=True)
    beside = torch.tensor([[0, 3], [0, 4]])
    reached = attention(features, beside, torch.zeros(2, dtype=torch.int64))[0].square().sum()
    (gradient,) = torch.autograd.grad(reached, features)
    assert float(gradient[1].abs().max()) > 0
    parted = attention(features, beside, torch.arange(2))[0].square().sum()
    (gradient,) = torch.autograd.grad(parted, features)
    assert float(gradient[1].abs().max()) == 0


def test_the_order_of_points_does_not_matter(encoder: LidarEncoder) -> None:
    made = cloud(4, items=3)
    mixed = torch.randperm(len(made.points), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(encoder(made[mixed], 3), encoder(made, 3), atol=1e-5, rtol=1e-4)


def test_a_sweep_is_embedded_alike_alone_and_beside_others(encoder: LidarEncoder) -> None:
    made = cloud(5, items=3)
    together = encoder(made, 3)
    for item in range(3):
        mine = made.points[made.item == item]
        alone = encoder(PointCloud(mine, torch.zeros(len(mine), dtype=torch.int64)), 1)
        torch.testing.assert_close(alone[0], together[item], atol=1e-5, rtol=1e-4)


def test_what_lies_beyond_the_grid_is_not_looked_at(encoder: LidarEncoder) -> None:
    made = cloud(6)
    far = torch.tensor(
        [[41.0, 0.0, 1.0, 0.5], [-0.1, 0.0, 1.0, 0.5], [5.0, 0.0, 5.1, 0.5], [5.0, 20.0, 1.0, 0.5]]
    )
    more = PointCloud(torch.cat([made.points, far]), torch.cat([made.item, made.item.new_zeros(4)]))
    torch.testing.assert_close(encoder(more, 1), encoder(made, 1), rtol=0, atol=0)


def test_sweeps_without_a_return_have_a_vector_too(encoder: LidarEncoder) -> None:
    nothing = PointCloud(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64))
    empty = encoder(nothing, 2)
    assert empty.isfinite().all()
    torch.testing.assert_close(empty[0], empty[1])
    made = cloud(7)
    last = PointCloud(made.points, made.item + 1)
    torch.testing.assert_close(encoder(last, 3)[[0, 2]], empty, atol=1e-6, rtol=1e-5)
    assert not torch.allclose(encoder(last, 3)[1], empty[0], atol=1e-3)


def test_padding_misses_and_what_is_not_finite_are_left_out() -> None:
    sweep = LidarSweep(
        origin_ego=torch.zeros(2, 4, 3),
        dir_ego=torch.eye(3)[torch.tensor([[0, 1, 2, 0], [0, 1, 2, 0]])],
        range_m=torch.tensor([[1.0, 2.0, 3.0, torch.nan], [4.0, torch.inf, 6.0, 7.0]]),
        returned=torch.tensor([[True, False, True, True], [True, True, True, True]]),
        intensity=torch.full((2, 4), 0.5),
        dt_s=torch.zeros(2, 4),
        beam=torch.zeros(2, 4, dtype=torch.int64),
        valid=torch.tensor([[True, True, True, True], [True, True, False, True]]),
    )
    made = PointCloud.from_sweeps(sweep)
    assert made.points.tolist() == [[1, 0, 0, 0.5], [0, 0, 3, 0.5], [4, 0, 0, 0.5], [7, 0, 0, 0.5]]
    assert made.item.tolist() == [0, 0, 1, 1]


def test_every_parameter_learns(encoder: LidarEncoder) -> None:
    encoder.zero_grad()
    encoder(cloud(8, count=2000, items=2), 2).square().sum().backward()
    still = [name for name, p in encoder.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert still == []
    encoder.zero_grad()


def test_tokens_that_are_not_there_do_not_count_in_a_pool() -> None:
    torch.manual_seed(0)
    pool = AttentionPool(8, 2, 5)
    tokens = torch.randn(2, 4, 8)
    filled = torch.tensor([[True, True, False, False], [True, True, True, True]])
    found = pool(tokens, filled)
    torch.testing.assert_close(found[:1], pool(tokens[:1, :2]), atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(found[1:], pool(tokens[1:]), atol=1e-6, rtol=1e-5)
