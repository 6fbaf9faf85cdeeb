"""The planner's geometry."""

import math
from typing import Literal

import pytest
import torch

from foredrive.methods.planner.ego_mlp import EgoMLPConfig
from foredrive.methods.planner.path_correction import PathCorrection, PathCorrectionConfig, headings
from foredrive.methods.planner.planner import FutureAttention, PlannerConfig, VolumePlanner
from foredrive.scene import VoxelSpec

SPEC = VoxelSpec(lower_m=(-4.0, -4.0, -1.0), voxel_m=1.0, shape_zyx=(2, 8, 8))


def small_planner(
    future: Literal["attention", "concatenation", "none"],
    *,
    history: int,
    steps: int,
    ego_mlp: EgoMLPConfig | None = None,
    path: PathCorrectionConfig | None = None,
    target: bool = False,
    final_norm: bool = False,
) -> VolumePlanner:
    config = PlannerConfig(
        width=16,
        layers=1,
        heads=2,
        future=future,
        pool=(1, 2, 2),
        history=history,
        ego_mlp=ego_mlp,
        path=path,
        target=target,
        final_norm=final_norm,
    )
    return VolumePlanner(config, SPEC, channels=4, horizon_steps=steps, dt_s=0.5).eval()


def path_correction(distances_m: tuple[float, ...], *, status: int, steps: int) -> PathCorrection:
    config = PathCorrectionConfig(distances_m=distances_m, width=8, hidden=4)
    return PathCorrection(config, SPEC, channels=3, status=status, steps=steps)


def test_headings_follow_the_path_and_hold_when_it_stops() -> None:
    xy = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [2.0, 2.01], [2.0, 2.0], [1.0, 2.0]])
    yaw = headings(xy[None, None])[0, 0]
    torch.testing.assert_close(yaw, torch.tensor([0, 0, math.pi / 2, math.pi / 2, math.pi / 2, math.pi]))


def test_attention_over_single_voxels_is_equation_13() -> None:
    """With blocks of one voxel the pooled form must be softmax(QKᵀ/√d)V ⊙ V_t exactly."""
    torch.manual_seed(0)
    attention = FutureAttention(4, (1, 1, 1))
    now, future = torch.randn(2, 1, 4, 2, 3, 3)
    tokens = future.flatten(2).transpose(1, 2)[0]
    q, k, v = attention.query(tokens), attention.key(tokens), attention.value(tokens)
    expected = (q @ k.T / math.sqrt(4)).softmax(-1) @ v
    expected = expected.T.view(1, 4, 2, 3, 3) * now
    torch.testing.assert_close(attention(now, future), expected)


@pytest.mark.parametrize("future", ["attention", "concatenation", "none"])
def test_the_next_volume_matters_where_it_is_looked_at(
    future: Literal["attention", "concatenation", "none"],
) -> None:
    torch.manual_seed(0)
    planner = small_planner(future, history=0, steps=6)
    now, one, other = torch.randn(3, 1, 4, 2, 8, 8)
    status = (torch.zeros(1, dtype=torch.int64), SEEN, torch.full((1,), 5.0), SEEN, torch.zeros(1, 0, 4))
    with torch.no_grad():
        same = torch.allclose(planner(now, one, *status).xy, planner(now, other, *status).xy)
    assert same == (future == "none") == (planner.imagined_frames == 0)
    if future != "none":
        with pytest.raises(ValueError, match="next volume"):
            planner(now, None, *status)


def test_where_nothing_is_learned_it_goes_straight_on() -> None:
    """With a last layer of zeros it is constant velocity, at the estimate where no speed was measured."""
    planner = small_planner("none", history=1, steps=3)
    torch.nn.init.zeros_(planner.waypoints[-1].weight)
    torch.nn.init.zeros_(planner.waypoints[-1].bias)
    volume, past = torch.randn(2, 4, 2, 8, 8), torch.randn(2, 1, 4)
    speed, known = torch.tensor([6.0, 2.0]), torch.tensor([True, False])
    plan = planner(volume, None, torch.zeros(2, dtype=torch.int64), known, speed, known, past)
    assert plan.xy[0, 0].tolist() == [[3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]
    assert plan.xy[1, 0].tolist() == [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]
    assert not plan.yaw.any()


def test_the_output_of_a_pre_norm_decoder_is_normalised_if_the_config_says_so() -> None:
    """Without the norm, what the layers add up to reaches the waypoints; with it, only its direction."""
    volume, past = torch.randn(1, 4, 2, 8, 8), torch.zeros(1, 0, 4)
    status = torch.tensor([1]), torch.tensor([True]), torch.tensor([5.0]), torch.tensor([True]), past
    found = {}
    for final_norm in (False, True):
        torch.manual_seed(0)
        planner = small_planner("none", history=0, steps=3, final_norm=final_norm)
        read: list[torch.Tensor] = []
        planner.waypoints.register_forward_pre_hook(lambda _, inputs, read=read: read.append(inputs[0]))
        planner(volume, None, *status)
        with torch.no_grad():
            for layer in planner.decoder:
                for last in (layer.self_attn.out_proj, layer.multihead_attn.out_proj, layer.linear2):
                    last.weight *= 100
                    last.bias *= 100
        planner(volume, None, *status)
        found[final_norm] = [values.norm().item() for values in read]
    before, after = found[False]
    assert after > 10 * before
    before, after = found[True]
    assert before == pytest.approx(4.0, rel=1e-2)  # 16 channels of mean 0 and variance 1
    assert after == pytest.approx(4.0, rel=1e-2)


def test_old_weights_of_a_planner_fit_without_the_norm() -> None:
    plain, normed = (small_planner("none", history=0, steps=3, final_norm=norm) for norm in (False, True))
    assert set(normed.state_dict()) - set(plain.state_dict()) == {"final_norm.weight", "final_norm.bias"}


def test_an_untrained_planner_drives_as_the_ego_mlp_it_starts_from() -> None:
    torch.manual_seed(0)
    path = PathCorrectionConfig(distances_m=(1.0, 3.0), width=8, hidden=4)
    planner = small_planner("none", history=1, steps=3, ego_mlp=EgoMLPConfig(), path=path)
    ego_mlp = planner.ego_mlp
    assert ego_mlp is not None
    x, y, yaw, before, now, known = -2.5, 0.1, 0.05, 4.0, 6.0, torch.tensor([True, False])
    past, speed = torch.tensor([[[x, y, yaw, before]]]).expand(2, 1, 4), torch.full((2,), now)
    command = torch.tensor([1, 1])
    plan = planner(torch.randn(2, 4, 2, 8, 8), None, command, known, speed, torch.tensor([True, True]), past)
    status = torch.tensor([[x, y, yaw, before, now, 0, 1, 0], [x, y, yaw, before, now, 0, 0, 0]])
    torch.testing.assert_close(plan.xy[:, 0], ego_mlp(status)[..., :2])


def test_a_planner_that_knows_where_the_route_leads_asks_and_goes_by_it() -> None:
    torch.manual_seed(0)
    planner = small_planner("none", history=0, steps=3, ego_mlp=EgoMLPConfig(), target=True)
    ego_mlp = planner.ego_mlp
    assert ego_mlp is not None
    known = (torch.zeros(1, dtype=torch.int64), SEEN, torch.full((1,), 5.0), SEEN, torch.zeros(1, 0, 4))
    volume, left = torch.randn(1, 4, 2, 8, 8), torch.tensor([[15.0, 9.0, 1.0]])
    plan = planner(volume, None, *known, left)
    status = torch.tensor([[5.0, 1.0, 0.0, 0.0, 15.0, 9.0, 1.0]])
    torch.testing.assert_close(plan.xy[:, 0], ego_mlp(status)[..., :2])
    torch.nn.init.normal_(planner.waypoints[-1].weight)  # what is learned beyond the MLP knows it too
    learned = [planner(volume, None, *known, lead).xy[:, 0] for lead in (left, -left)]
    initial = [planner.initial_plan(*known[:3], known[4], lead)[0] for lead in (left, -left)]
    assert not torch.allclose(learned[0] - initial[0], learned[1] - initial[1])
    with pytest.raises(ValueError, match="target point"):
        planner(volume, None, *known)


def test_a_path_is_read_along_its_curve_and_beyond_its_end() -> None:
    """3 m ahead, then 4 m to the left: distances 1.5, 5 and 9 m lie on both legs and 2 m beyond."""
    reading = path_correction((1.5, 5.0, 9.0), status=0, steps=2)
    places = reading.positions_m(torch.tensor([[[3.0, 0.0], [3.0, 4.0]]]))[0]
    right, middle, left = places.unbind(1)
    torch.testing.assert_close(middle, torch.tensor([[1.5, 0.0], [3.0, 2.0], [3.0, 6.0]]))
    torch.testing.assert_close(left, torch.tensor([[1.5, 3.0], [0.0, 2.0], [0.0, 6.0]]))
    torch.testing.assert_close(right, torch.tensor([[1.5, -3.0], [6.0, 2.0], [6.0, 6.0]]))
    standing = reading.positions_m(torch.zeros(1, 2, 2))[0, :, 1]  # looks straight ahead
    torch.testing.assert_close(standing, torch.tensor([[1.5, 0.0], [5.0, 0.0], [9.0, 0.0]]))


def test_what_stands_on_the_path_matters_and_what_stands_elsewhere_does_not() -> None:
    torch.manual_seed(0)
    reading = path_correction((1.0, 2.5), status=1, steps=1).eval()
    torch.nn.init.normal_(reading.change[-2].weight)
    path = torch.tensor([[[2.5, 0.0]]])

    def change(volume: torch.Tensor) -> torch.Tensor:
        return reading(reading.sample(volume, path), torch.ones(1, 1))

    volume = torch.randn(1, 3, 2, 8, 8)
    on_path, elsewhere = volume.clone(), volume.clone()
    on_path[0, :, 1, 4, 6] += 1  # x 2 to 3 m, y 0 to 1 m
    elsewhere[0, :, 1, 4, 1] += 1  # behind
    assert not torch.allclose(change(on_path), change(volume))
    torch.testing.assert_close(change(elsewhere), change(volume))
    sampled = reading.sample(volume, path).values[0, 1, 1]  # at x 2.5 m, y 0: between two cells
    torch.testing.assert_close(sampled, volume[0, :, :, 3:5, 6].mean(-1).T.flatten())


SEEN = torch.ones(1, dtype=torch.bool)
