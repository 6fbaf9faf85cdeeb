"""Reading and warping volumes: hand-computed cases, the references' gradients, the fast paths beside them."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from foredrive.geometry.se3 import exp_se3, inverse_se3, matrix_from_yaw
from foredrive.ops.attention3d import attend_volume, attend_volume_reference
from foredrive.ops.volume import compose_flows, sample_volume, sample_volume_reference, warp_volume

Parity = Callable[..., None]
Op = Callable[..., Tensor]


@pytest.fixture(scope="session", params=["numba", "triton"])
def path(request: pytest.FixtureRequest) -> str:
    """Which kernels."""
    return request.param


@pytest.fixture(scope="session")
def attend(path: str, triton_op: Callable[[str, str], Op]) -> Op:
    """A fast path of attention."""
    return attend_volume if path == "numba" else triton_op("volume_triton", "attend_volume_triton")


@pytest.fixture(scope="session")
def sample(path: str, triton_op: Callable[[str, str], Op]) -> Op:
    """A fast path of sampling."""
    return (
        sample_volume if path == "numba" else sampled_by(triton_op("volume_triton", "attend_volume_triton"))
    )


def sampled_by(attend: Op) -> Op:
    """Sampling as `sample_volume` does it: attention of one head to one point of weight 1."""
    return lambda volume, points: attend(
        volume, points[:, :, None, None], points.new_ones(*points.shape[:2], 1, 1)
    )


def volume_case(
    seed: int, *, b: int, channels: int, size_zyx: tuple[int, int, int], points: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Channels-last values, and points in and around them, none near a kink of the gradients."""
    rng = torch.Generator().manual_seed(seed)
    values = torch.randn(b, *size_zyx, channels, generator=rng)
    size_xyz = torch.tensor(size_zyx[::-1])
    cell = (torch.rand(b, *points, 3, generator=rng) * (size_xyz + 5)).floor() - 3
    return values, cell + 0.55 + 0.9 * torch.rand(b, *points, 3, generator=rng)


def attention_case(
    seed: int,
    *,
    b: int = 2,
    queries: int = 31,
    heads: int = 2,
    width: int = 8,
    points: int = 3,
    size_zyx: tuple[int, int, int] = (2, 3, 4),
) -> list[Tensor]:
    values, places = volume_case(
        seed, b=b, channels=heads * width, size_zyx=size_zyx, points=(queries, heads, points)
    )
    weights = torch.randn(b, queries, heads, points, generator=torch.Generator().manual_seed(seed + 1))
    return [values, places, weights]


def sample_one(sample: Op, volume: Tensor, x: float, y: float, z: float) -> float:
    return sample(volume[None, ..., None], torch.tensor([[[x, y, z]]])).item()


def test_trilinear_reading_by_hand(sample: Op) -> None:
    assert sample_one(sample, torch.full((1, 1, 1), 8.0), 0.5, 0.5, 0.5) == 8
    assert sample_one(sample, torch.full((1, 1, 1), 8.0), 1.0, 0.5, 0.5) == 4  # a face
    assert sample_one(sample, torch.full((1, 1, 1), 8.0), 0.0, 0.0, 1.0) == 1  # a corner
    assert sample_one(sample, torch.full((1, 1, 1), 8.0), -0.5, 0.5, 0.5) == 0
    volume = torch.arange(24.0).view(2, 3, 4)  # z y x
    assert sample_one(sample, volume, 3.5, 0.5, 0.5) == 3
    assert sample_one(sample, volume, 0.5, 2.5, 0.5) == 8
    assert sample_one(sample, volume, 0.5, 0.5, 1.5) == 12
    assert sample_one(sample, volume, 2.0, 1.75, 0.75) == 1.5 + 1.25 * 4 + 0.25 * 12


def test_attention_by_hand(attend: Op) -> None:
    values = torch.stack([torch.arange(4.0), 10 * torch.arange(4.0)], dim=-1).view(1, 1, 1, 4, 2)
    x = torch.tensor([[0.5, 2.5], [1.0, 3.5]])  # two heads of two points
    points = torch.stack([x, torch.full_like(x, 0.5), torch.full_like(x, 0.5)], dim=-1).view(1, 1, 2, 2, 3)
    weights = torch.tensor([[0.25, 0.75], [0.5, 0.5]]).view(1, 1, 2, 2)
    assert attend(values, points, weights).flatten().tolist() == [0.75 * 2, 0.5 * 5 + 0.5 * 30]


def test_gradients_of_the_references() -> None:
    values, points, weights = attention_case(0, b=2, queries=3, width=2, points=2, size_zyx=(2, 2, 3))
    doubles = [x.double().requires_grad_() for x in (values, points, weights)]
    assert torch.autograd.gradcheck(attend_volume, doubles)
    assert torch.autograd.gradcheck(sample_volume, [doubles[0], points[:, :, 0, 0].double().requires_grad_()])


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**16),
    b=st.integers(1, 3),
    queries=st.integers(1, 90),
    heads=st.integers(1, 4),
    width=st.sampled_from([1, 3, 8, 12, 16]),
    points=st.integers(1, 9),
    size_zyx=st.tuples(*[st.integers(1, 5)] * 3),
)
def test_attention_is_its_reference(parity: Parity, seed: int, **shape: int) -> None:
    parity(attend_volume, attend_volume_reference, attention_case(seed, **shape))


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**16),
    b=st.integers(1, 3),
    count=st.integers(1, 400),
    channels=st.sampled_from([1, 2, 8, 15, 33, 40]),
    size_zyx=st.tuples(*[st.integers(1, 5)] * 3),
)
def test_sampling_is_its_reference(
    parity: Parity, seed: int, b: int, count: int, channels: int, size_zyx: tuple[int, int, int]
) -> None:
    case = volume_case(seed, b=b, channels=channels, size_zyx=size_zyx, points=(count,))
    parity(sample_volume, sample_volume_reference, case)


@pytest.mark.parametrize(
    "shape",
    [
        {"queries": 9},
        {"b": 1, "queries": 5, "heads": 3, "width": 5, "size_zyx": (1, 3, 2)},
        {"b": 1, "queries": 3, "heads": 1, "points": 19},
    ],
)
def test_attention_by_triton_is_its_reference(
    parity: Parity, triton_op: Callable[[str, str], Op], shape: dict[str, Any]
) -> None:
    attend = triton_op("volume_triton", "attend_volume_triton")
    parity(attend, attend_volume_reference, attention_case(4, **shape))


@pytest.mark.parametrize("channels", [1, 33])
def test_sampling_by_triton_is_its_reference(
    parity: Parity, triton_op: Callable[[str, str], Op], channels: int
) -> None:
    sample = sampled_by(triton_op("volume_triton", "attend_volume_triton"))
    case = volume_case(3, b=2, channels=channels, size_zyx=(2, 3, 4), points=(40,))
    parity(sample, sample_volume_reference, case)


@pytest.mark.parametrize("channels", [1, 33])
def test_sampling_where_threads_share_the_work(parity: Parity, channels: int) -> None:
    case = volume_case(8, b=2, channels=channels, size_zyx=(6, 9, 11), points=(5000,))
    parity(sample_volume, sample_volume_reference, case)


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    inputs = attention_case(5, queries=2000, heads=4)
    volume, points = volume_case(6, b=1, channels=40, size_zyx=(4, 5, 6), points=(2000,))
    threads = torch.get_num_threads()
    results = []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            leaves = [x.clone().requires_grad_() for x in (*inputs, volume, points)]
            attended, sampled = attend_volume(*leaves[:3]), sample_volume(*leaves[3:])
            loss = attended.square().sum() + sampled.square().sum()
            results.append([attended.detach(), sampled.detach(), *torch.autograd.grad(loss, leaves)])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("wanted", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0, 0)])
def test_gradients_of_some_inputs_only(
    attend: Op, sample: Op, parity: Parity, wanted: tuple[int, ...]
) -> None:
    flags = [bool(w) for w in wanted]
    values, points, weights = attention_case(1, queries=9)
    parity(attend, attend_volume_reference, [values, points, weights], flags)
    parity(sample, sample_volume_reference, [values, points[:, :, 0, 0]], flags[:2])


def test_inputs_may_lie_in_memory_as_they_like(attend: Op) -> None:
    values, points, weights = attention_case(2, queries=9)
    turned = values.permute(0, 4, 1, 2, 3).contiguous().permute(0, 2, 3, 4, 1)
    assert torch.equal(
        attend(turned, points.flip(1), weights.flip(1)), attend(values, points, weights).flip(1)
    )
    repeated = points[:, :1].expand_as(points)
    assert torch.equal(attend(values, repeated, weights), attend(values, repeated.contiguous(), weights))


@pytest.mark.parametrize("empty", [{"b": 0}, {"queries": 0}])
def test_nothing_to_read(attend: Op, sample: Op, empty: dict[str, int]) -> None:
    leaves = [x.requires_grad_() for x in attention_case(0, **empty)]
    for out in (attend(*leaves), sample(leaves[0], leaves[1][:, :, 0, 0])):
        assert out.numel() == 0
        assert not torch.autograd.grad(out.sum(), leaves[0])[0].any()


@pytest.mark.filterwarnings("ignore:(overflow|invalid value) encountered:RuntimeWarning")  # interpreted
def test_far_away_reads_zero_and_never_outside_the_memory(
    attend: Op, sample: Op, guard: Callable[[Tensor], Tensor], wild: Tensor
) -> None:
    inside = torch.tensor([1.0])
    reach = torch.cat([wild, inside])
    places = torch.cartesian_prod(reach, reach, reach)
    places = places[(places != inside).any(-1)].requires_grad_()
    volume = guard(torch.ones(1, 2, 3, 4, 9)).requires_grad_()
    out = sample(volume, places[None])
    assert torch.equal(out, torch.zeros_like(out))
    assert not any(g.any() for g in torch.autograd.grad(out.sum(), [volume, places]))
    weights = torch.ones(1, len(places), 1, 1)
    assert not attend(volume, places[None, :, None, None], weights).any()


def test_the_border_reads_nothing_outside_the_memory(sample: Op, guard: Callable[[Tensor], Tensor]) -> None:
    volume, points = volume_case(9, b=1, channels=9, size_zyx=(2, 3, 4), points=(500,))
    assert torch.equal(sample(guard(volume), points), sample(volume, points))


def test_nan_goes_to_the_query_it_belongs_to_and_no_further(attend: Op, sample: Op) -> None:
    values, points, weights = attention_case(0, b=1, queries=9)
    points[0, 0, 0, 1, 2] = torch.nan
    weights[0, 1, 1, 0] = torch.nan
    for op in (attend, attend_volume_reference):
        nan = op(values, points, weights)[0].unflatten(-1, (2, 8)).isnan()
        assert nan[0].all(-1).tolist() == [True, False]
        assert nan[1].all(-1).tolist() == [False, True]
        assert not nan[2:].any()
    for op in (sample, sample_volume_reference):
        nan = op(values, points[:, :, 0, 1]).isnan()
        assert nan[0, 0].all()
        assert not nan[0, 1:].any()
    values[0, 0, 0, 0, 3] = torch.nan
    read = sample(values, torch.tensor([[[0.75, 0.5, 0.5], [1.75, 1.5, 0.5]]])).isnan()
    assert read[0].nonzero().tolist() == [[0, 3]]


def test_half_precision_is_computed_in_full_precision(attend: Op) -> None:
    leaves = [x.bfloat16().requires_grad_() for x in attention_case(0, queries=9)]
    expected = attend(*[x.float() for x in leaves])
    with torch.autocast("cpu", torch.bfloat16):
        out = attend(*leaves)
        reference = attend_volume_reference(*leaves)
    assert out.dtype == reference.dtype == torch.float32
    assert torch.equal(out, expected)
    torch.testing.assert_close(out, reference, rtol=1e-4, atol=1e-4)
    assert all(g.dtype == torch.bfloat16 for g in torch.autograd.grad(out.sum(), leaves))


def test_shapes_that_do_not_fit_are_refused() -> None:
    values, points, weights = attention_case(0)
    with pytest.raises(ValueError, match="multiple of H"):
        attend_volume(values[..., :15], points, weights)
    with pytest.raises(ValueError, match="do not fit"):
        attend_volume(values[:, :0], points, weights)
    with pytest.raises(ValueError, match="cannot read"):
        sample_volume(values[:, :0], points[:, :, 0, 0])


SIZE_ZYX, LOWER_M, VOXEL_M = (3, 4, 4), (-1.0, -1.0, 2.0), 0.5


def scene(seed: int = 0, b: int = 1) -> tuple[Tensor, Tensor]:
    """A volume (x and y centred on the origin) and no flow."""
    volume = torch.rand(b, 2, *SIZE_ZYX, generator=torch.Generator().manual_seed(seed))
    return volume, torch.zeros(b, 3, *SIZE_ZYX)


def test_warp_leaves_what_does_not_move() -> None:
    volume, still = scene(b=2)
    warped = warp_volume(volume, still, torch.eye(4).expand(2, 4, 4), LOWER_M, VOXEL_M)
    torch.testing.assert_close(warped, volume, rtol=0, atol=1e-6)


def test_warp_follows_the_ego_vehicle() -> None:
    """The vehicle drives one voxel forward: what stood at x + 1 stands at x, and the far end is unknown."""
    volume, still = scene()
    T_now_next = matrix_from_yaw(torch.zeros(1), torch.tensor([[VOXEL_M, 0.0, 0.0]]))
    warped = warp_volume(volume, still, T_now_next, LOWER_M, VOXEL_M)
    torch.testing.assert_close(warped[..., :-1], volume[..., 1:], rtol=0, atol=1e-6)
    assert warped[..., -1].abs().max() < 1e-6


def test_warp_applies_the_flow_on_the_grid_of_the_source() -> None:
    """One voxel moves while the vehicle turns by a quarter: the moved content turns with the rest."""
    volume, flow = scene()
    flow[:, 0, :, 2, 1] = VOXEL_M  # what lies at row y = 2, column x = 1 of the source came from x = 2
    quarter = matrix_from_yaw(torch.tensor([math.pi / 2]), torch.zeros(1, 3))
    moved = volume.clone()
    moved[..., 2, 1] = volume[..., 2, 2]
    expected = moved.transpose(-1, -2).flip(-2)  # out[y, x] = in[x, 3 - y], as R (x, y) = (-y, x)
    warped = warp_volume(volume, flow, quarter, LOWER_M, VOXEL_M)
    torch.testing.assert_close(warped, expected, rtol=0, atol=1e-5)


def test_warp_shows_zero_where_the_source_ends() -> None:
    """After 1.5 voxels forward, the last column is outside and half of the one before is."""
    volume, still = scene()
    T_now_next = matrix_from_yaw(torch.zeros(1), torch.tensor([[1.5 * VOXEL_M, 0.0, 0.0]]))
    warped = warp_volume(volume, still, T_now_next, LOWER_M, VOXEL_M)
    torch.testing.assert_close(warped[0, :, 0, 0, 3], torch.zeros(2), rtol=0, atol=1e-5)
    torch.testing.assert_close(warped[0, :, 0, 0, 2], 0.5 * volume[0, :, 0, 0, 3], rtol=0, atol=1e-5)


def test_flows_one_after_the_other() -> None:
    """The last flow leads one voxel up in x, and the earlier flow is read there."""
    last, before = torch.zeros(1, 3, *SIZE_ZYX), torch.zeros(1, 3, *SIZE_ZYX)
    last[:, 0, 1, 2, 1] = VOXEL_M
    before[:, 1, 1, 2, 2] = 3.0
    both = compose_flows(last, before, VOXEL_M)
    torch.testing.assert_close(both[0, :, 1, 2, 1], torch.tensor([VOXEL_M, 3.0, 0.0]), rtol=0, atol=1e-5)
    torch.testing.assert_close(both[0, :, 1, 2, 2], torch.tensor([0.0, 3.0, 0.0]), rtol=0, atol=1e-5)


def test_warp_there_and_back_is_smooth() -> None:
    z, y, x = torch.meshgrid(*[torch.linspace(-2, 2, 24)] * 3, indexing="ij")
    blob = torch.exp(-(x**2 + y**2 + z**2) / 0.5)[None, None]
    T = exp_se3(torch.tensor([[0.3, -0.2, 0.1, 0.05, 0.1, 0.3]]))
    still = torch.zeros(1, 3, 24, 24, 24)
    there = warp_volume(blob, still, T, (-2.0, -2.0, -2.0), 4 / 24)
    back = warp_volume(there, still, inverse_se3(T), (-2.0, -2.0, -2.0), 4 / 24)
    assert (back - blob).abs().max() < 0.08


def test_warp_is_differentiable_in_volume_flow_and_motion() -> None:
    volume, flow = (x.double() for x in scene())
    flow = (
        flow + 0.11 + 0.02 * torch.rand(flow.shape, generator=torch.Generator().manual_seed(1))
    ).requires_grad_()
    xi = torch.tensor([[0.06, -0.04, 0.05, 0.01, 0.02, 0.03]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda v, f, x: warp_volume(v, f, exp_se3(x), LOWER_M, VOXEL_M), [volume.requires_grad_(), flow, xi]
    )


def test_warp_of_a_channels_last_volume_copies_nothing_wrong(parity: Parity) -> None:
    volume, flow = scene(b=2)
    T = exp_se3(torch.tensor([[0.06, -0.04, 0.05, 0.01, 0.02, 0.03]] * 2))
    flow = flow + 0.11
    last = volume.contiguous(memory_format=torch.channels_last_3d)

    def double(v: Tensor, f: Tensor, T: Tensor) -> Tensor:
        return warp_volume(v.double(), f.double(), T.double(), LOWER_M, VOXEL_M).float()

    parity(lambda *a: warp_volume(*a, LOWER_M, VOXEL_M), double, [volume, flow, T])
    assert torch.equal(
        warp_volume(last, flow, T, LOWER_M, VOXEL_M), warp_volume(volume, flow, T, LOWER_M, VOXEL_M)
    )


def test_an_exported_program_holds_the_reference() -> None:
    class Attend(torch.nn.Module):
        def forward(self, values: Tensor, points: Tensor, weights: Tensor) -> Tensor:
            return attend_volume(values, points, weights)

    inputs = attention_case(0)
    exported = torch.export.export(Attend(), tuple(inputs)).module()
    torch.testing.assert_close(exported(*inputs), attend_volume(*inputs), rtol=1e-4, atol=1e-4)
