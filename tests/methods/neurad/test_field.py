"""Neural fields: contraction, samples, rays with times, actors, and a small field that learns a wall."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from foredrive.geometry.se3 import exp_se3
from foredrive.methods.neurad import (
    FieldActors,
    FieldConfig,
    FieldRays,
    GridConfig,
    NeuralField,
    beam_rays,
    pixel_rays,
)
from foredrive.methods.neurad.config import GridsConfig
from foredrive.methods.neurad.decoders import BeamDecoder, PatchDecoder, PatchDecoderConfig
from foredrive.methods.neurad.losses import beam_depth_loss, carving_loss, interlevel_loss
from foredrive.methods.neurad.network import ActorSamples, contract, harmonics, opacity_of_density
from foredrive.methods.neurad.sampling import (
    Resampling,
    first_borders,
    resampled_borders,
    to_distance,
    to_position,
)
from foredrive.methods.reconstruction.reconstructed import SensorMotion
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.scene import LidarSweep


def test_contraction_keeps_the_inner_cube_and_draws_the_rest_together() -> None:
    points = torch.tensor([[0.0, 0, 0], [5, -10, 2], [0, 20, 0], [1e9, 0, -1e9]])
    found, _ = contract(points, torch.ones(4), scale_m=10.0)
    expected = torch.tensor([[0.5, 0.5, 0.5], [0.625, 0.25, 0.55], [0.5, 0.875, 0.5], [1, 0.5, 0]])
    torch.testing.assert_close(found, expected)


def test_footprints_shrink_as_volumes_do() -> None:
    points = 30 * torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    _, footprint = contract(points, torch.full((20,), 2.0, dtype=torch.float64), 10.0)
    for point, size in zip(points, footprint, strict=True):
        jacobian = torch.autograd.functional.jacobian(
            lambda x: contract(x[None], torch.ones(1, dtype=torch.float64), 10.0)[0][0], point
        )
        torch.testing.assert_close(size, 2 * torch.linalg.det(jacobian).abs() ** (1 / 3))


def test_positions_and_distances_are_inverse_and_half_of_them_lie_within_the_spacing() -> None:
    s = torch.linspace(0, 1, 11)
    distance = to_distance(s, 20.0, 20_000.0)
    torch.testing.assert_close(to_position(distance, 20.0, 20_000.0), s)
    assert distance[0] == 0
    assert distance[-1].item() == pytest.approx(20_000, rel=1e-3)
    assert 19.9 < distance[5] < 20.1


@pytest.mark.parametrize("seed", [None, 0])
def test_samples_are_drawn_where_the_weight_lies(seed: int | None) -> None:
    rng = None if seed is None else torch.Generator().manual_seed(seed)
    border = first_borders(3, 10, rng, torch.zeros(()))
    assert border.shape == (3, 11)
    assert bool((border.diff(dim=-1) > 0).all())
    weight = torch.full((3, 10), 1e-6)
    weight[:, 4] = 1.0
    found = resampled_borders(border, weight, 20, rng)
    assert bool((found.diff(dim=-1) >= 0).all())
    assert bool((found[:, 0] == 0).all() and (found[:, -1] == 1).all())
    inside = (found >= border[:, 4:5]) & (found <= border[:, 5:6])
    assert bool((inside.sum(-1) >= 18).all())


def test_padded_samples_are_the_middles_of_quantiles() -> None:
    """With 0.01 each, the weights are 0.8, 0.1, 0.1, 0.01 of 1.01. The five borders are at (k + 1/2) / 5."""
    border = torch.tensor([[0.0, 0.2, 0.4, 0.5, 1.0]])
    weight = torch.tensor([[0.79, 0.09, 0.09, 0.0]])
    found = resampled_borders(border, weight, 4, None, "padded")
    first = [0.2 * 1.01 * u / 0.8 for u in (0.1, 0.3, 0.5, 0.7)]
    expected = [*first, 0.4 + 0.1 * (1.01 * 0.9 - 0.9) / 0.1]
    torch.testing.assert_close(found, torch.tensor([expected]))


@pytest.mark.parametrize(("how", "share"), [("greedy", 0.98), ("padded", 1.01 / 2.28)])
@pytest.mark.parametrize("seed", [None, 0])
def test_padded_samples_look_elsewhere_too(how: Resampling, share: float, seed: int | None) -> None:
    """128 intervals of which one has all weight: 1.01 of 1 + 1.28 with 0.01 added to each."""
    rng = None if seed is None else torch.Generator().manual_seed(seed)
    border, weight = torch.linspace(0, 1, 129).expand(50, -1), torch.zeros(50, 128)
    weight[:, 40] = 1.0
    found = resampled_borders(border, weight, 64, rng, how)
    middle = 0.5 * (found[:, 1:] + found[:, :-1])
    inside = (middle > border[:, 40:41]) & (middle < border[:, 41:42])
    assert float(inside.float().mean()) == pytest.approx(share, abs=0.03)
    assert bool((found.diff(dim=-1) > 0).all())


def camera(twist: list[float], readout_s: float) -> CameraView:
    return CameraView(
        K=torch.tensor([[100.0, 0, 60], [0, 100, 45], [0, 0, 1]]),
        dist=torch.zeros(5),
        T_scene_cam=exp_se3(torch.tensor([1.0, 2, 3, 0.1, -0.2, 0.5])),
        twist_cam=torch.tensor(twist),
        t_s=2.0,
        readout_s=readout_s,
        size_hw=(90, 120),
        sensor=0,
    )


def exposed(view: CameraView) -> SensorMotion:
    return SensorMotion(view.T_scene_cam, view.twist_cam, torch.tensor(view.t_s))


def test_rows_of_an_image_have_their_own_pose_and_time() -> None:
    """The camera moves at 10 m/s along its axis and turns by 1 rad/s about its y axis, in 0.1 s."""
    view = camera([0.0, 0, 10, 0, 1, 0], readout_s=0.1)
    uv = torch.tensor([[60.0, 0], [60, 45], [60, 90]])
    rays = pixel_rays(view, exposed(view), uv)
    torch.testing.assert_close(rays.t_s, torch.tensor([1.95, 2, 2.05]))
    torch.testing.assert_close(rays.origin[1], view.T_scene_cam[:3, 3])
    R = view.T_scene_cam[:3, :3]
    way = (rays.origin[2] - rays.origin[0]) @ R
    torch.testing.assert_close(way, torch.tensor([0, 0, 1.0]), atol=2e-3, rtol=0)
    last = rays.direction[2] @ R
    down = torch.tensor([0.0, 0.45, 1.0]) / math.hypot(0.45, 1)
    turned = torch.tensor(
        [[math.cos(0.05), 0, math.sin(0.05)], [0, 1, 0], [-math.sin(0.05), 0, math.cos(0.05)]]
    )
    torch.testing.assert_close(last, turned @ down)


def test_the_area_of_a_pixel_is_its_solid_angle() -> None:
    view = camera([0.0] * 6, 0.0)
    uv = torch.tensor([[60.0, 45.0], [110.0, 80.0]])
    small = 1e-2
    around = [
        pixel_rays(view, exposed(view), uv + small * torch.tensor(d)).direction
        for d in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))
    ]
    area = torch.linalg.cross(around[0] - around[1], around[2] - around[3]).norm(dim=-1) / small**2
    torch.testing.assert_close(pixel_rays(view, exposed(view), uv).area, area, rtol=2e-2, atol=0)
    torch.testing.assert_close(
        pixel_rays(view, exposed(view), uv, side_px=3.0).area, 9 * pixel_rays(view, exposed(view), uv).area
    )


def test_beams_have_their_own_origins_and_times() -> None:
    beams = LidarSweep(
        origin_ego=torch.tensor([[0.0, 0, 2], [0.5, 0, 2]]),
        dir_ego=torch.tensor([[1.0, 0, 0], [0, 1, 0]]),
        range_m=torch.ones(2),
        returned=torch.ones(2, dtype=torch.bool),
        intensity=torch.ones(2),
        dt_s=torch.tensor([-0.1, -0.05]),
        beam=torch.zeros(2, dtype=torch.int64),
        valid=torch.ones(2, dtype=torch.bool),
    )
    T_scene_ego = exp_se3(torch.tensor([0.0, 0, 0, 0, 0, math.pi / 2]))
    T_scene_ego[:3, 3] = torch.tensor([10.0, 0, 0])
    rays = beam_rays(SweepView(beams, True, T_scene_ego, torch.zeros(6), 3.0))
    torch.testing.assert_close(rays.t_s, torch.tensor([2.9, 2.95]))
    torch.testing.assert_close(rays.origin, torch.tensor([[10.0, 0, 2], [10, 0.5, 2]]))
    torch.testing.assert_close(rays.direction, torch.tensor([[0.0, 1, 0], [-1, 0, 0]]), atol=1e-6, rtol=0)


def test_harmonics_are_orthonormal() -> None:
    direction = torch.randn(400_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = harmonics(torch.nn.functional.normalize(direction, dim=-1))
    gram = 4 * math.pi * found @ found.T / len(direction)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=0.02, rtol=0)


SMALL = FieldConfig(
    grids=GridsConfig(GridConfig(4, 2, 8, 128, 12), GridConfig(2, 2, 8, 32, 10)),
    proposals=(GridsConfig(GridConfig(3, 1, 8, 64, 12), GridConfig(2, 1, 8, 32, 10)),),
    proposal_samples=(24,),
    samples=12,
    width=16,
    scale_m=20.0,
)


def tracks(*poses: Tensor) -> ActorTracks:
    """Standing actors of 4 × 2 × 2 m at two key times."""
    count = len(poses)
    return ActorTracks(
        track_id=torch.arange(count),
        category=torch.zeros(count, dtype=torch.int64),
        size_lwh=torch.tensor([[4.0, 2, 2]]).repeat(count, 1),
        t_s=torch.tensor([0.0, 1.0]),
        T_scene_actor=torch.stack(poses)[:, None].repeat(1, 2, 1, 1) if count else torch.zeros(0, 2, 4, 4),
        present=torch.ones(count, 2, dtype=torch.bool),
    )


NOBODY = FieldActors(tracks(), torch.zeros(0, dtype=torch.int64))


def pose(x: float, y: float, yaw: float) -> Tensor:
    T = exp_se3(torch.tensor([0.0, 0, 0, 0, 0, yaw]))
    T[:2, 3] = torch.tensor([x, y])
    return T


def in_front_of(T: Tensor, count: int = 40) -> FieldRays:
    """Rays from 8 m before a box towards it."""
    rng = torch.Generator().manual_seed(1)
    target = torch.rand(count, 3, generator=rng) - 0.5
    origin = torch.tensor([-8.0, 1.0, 0.5])
    way = torch.nn.functional.normalize(target - origin, dim=-1)
    return FieldRays(
        (T[:3, :3] @ origin + T[:3, 3]).expand(count, 3),
        way @ T[:3, :3].T,
        torch.full((count,), 0.3),
        torch.full((count,), 1e-5),
    )


def small_field(actors: int, **changes: object) -> NeuralField:
    torch.manual_seed(0)
    net = NeuralField(dataclasses.replace(SMALL, **changes), actors, torch.zeros(3))  # type: ignore[arg-type]
    with torch.no_grad():
        for parameter in net.grids.parameters():
            parameter.uniform_(-1, 1)
    return net


def moving_samples(net: NeuralField, rays: FieldRays, actors: FieldActors) -> ActorSamples:
    border = to_distance(first_borders(len(rays.origin), 64, None, rays.origin), 20.0, 20_000.0)
    _, _, moving = net._samples(rays, border, net.crossings(rays, actors.tracks), actors, learn_poses=True)
    assert moving is not None
    return moving


def test_an_actor_looks_the_same_wherever_it_stands() -> None:
    """Two boxes with one place in the grid: what a sample reads depends on its position in the box alone."""
    net = small_field(2)
    poses = pose(10, 3, 0.7), pose(-20, 5, -2.0)
    actors = FieldActors(tracks(*poses), torch.tensor([1, 1]))
    first, second = (moving_samples(net, in_front_of(T), actors) for T in poses)
    assert len(first.sample) > 40
    torch.testing.assert_close(first.point_m, second.point_m, atol=1e-4, rtol=0)
    torch.testing.assert_close(first.direction, second.direction, atol=1e-5, rtol=0)
    other = FieldActors(actors.tracks, torch.tensor([0, 1]))
    standing = torch.zeros(40 * 64, 3), torch.ones(40 * 64)
    read = [net.grids(*standing, found)[:, found.sample] for found in (first, second)]
    torch.testing.assert_close(*read, atol=1e-3, rtol=0)
    changed = moving_samples(net, in_front_of(poses[0]), other)
    assert (net.grids(*standing, changed)[:, changed.sample] - read[0]).abs().max() > 0.1


def test_a_mirrored_actor_is_read_on_its_other_side() -> None:
    net, T = small_field(1), pose(10, 3, 0.7)
    held = tracks(T)
    plain = moving_samples(net, in_front_of(T), FieldActors(held, torch.zeros(1, dtype=torch.int64)))
    turned = FieldActors(held, torch.zeros(1, dtype=torch.int64), torch.ones(1, dtype=torch.bool))
    mirrored = moving_samples(net, in_front_of(T), turned)
    other_side = torch.tensor([1.0, -1, 1])
    torch.testing.assert_close(mirrored.point_m, plain.point_m * other_side)
    torch.testing.assert_close(mirrored.direction, plain.direction * other_side)


def test_where_boxes_overlap_a_sample_belongs_to_the_one_entered_last() -> None:
    net = small_field(2)
    T = pose(10, 0, 0)
    actors = FieldActors(tracks(pose(11, 0, 0), T), torch.tensor([0, 1]))
    rays = FieldRays(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), torch.zeros(1), torch.ones(1) * 1e-5)
    moving = moving_samples(net, rays, actors)
    assert len(moving.sample.unique()) == len(moving.sample)
    border = to_distance(first_borders(1, 64, None, torch.zeros(())), 20.0, 20_000.0)
    middle = (0.5 * (border[0, 1:] + border[0, :-1]))[moving.sample]
    assert bool((moving.slot == (middle < 11 - 2.25).long()).all())  # from there on it is in both
    assert moving.slot.unique().tolist() == [0, 1]


@pytest.mark.parametrize("shading", ["samples", "rays"])
def test_directions_in_a_box_are_those_of_its_frame(shading: str) -> None:
    """A ray that ends at a sample of an actor looks as one with the direction in the frame of the box."""
    net = small_field(1, shading=shading)
    rng = torch.Generator().manual_seed(3)
    embedding = torch.randn(16, 3, 2, generator=rng)
    direction = torch.nn.functional.normalize(torch.randn(3, 3, generator=rng), dim=-1)
    own = torch.nn.functional.normalize(torch.randn(1, 3, generator=rng), dim=-1)
    sample, slot = torch.tensor([3]), torch.zeros(1, dtype=torch.int64)  # the second one of ray 1
    moving = ActorSamples(sample, slot, torch.zeros(1, 3), own, torch.ones(1))
    replaced = direction.clone()
    replaced[1] = own
    for weight, same in (((0.0, 1.0), replaced), ((1.0, 0.0), direction)):
        weights = torch.tensor(weight).expand(3, 2)
        found = net.layers.seen(embedding, weights, direction, moving)
        torch.testing.assert_close(found, net.layers.seen(embedding, weights, same, None))


def test_both_shadings_agree_where_one_sample_stops_the_ray() -> None:
    rng = torch.Generator().manual_seed(4)
    embedding, weight = torch.randn(16, 5, 3, generator=rng), torch.zeros(5, 3)
    weight[:, 1] = 1
    direction = torch.nn.functional.normalize(torch.randn(5, 3, generator=rng), dim=-1)
    found = [
        small_field(0, shading=s).layers.seen(embedding, weight, direction, None) for s in ("samples", "rays")
    ]
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("surface", ["sdf", "density"])
def test_rays_give_gradients_to_all_weights_and_to_poses(surface: str) -> None:
    net = small_field(1, surface=surface)
    T = pose(10, 3, 0.7)
    held = tracks(T)
    held = dataclasses.replace(held, T_scene_actor=held.T_scene_actor.clone().requires_grad_())
    rays = in_front_of(T)
    origin = rays.origin.clone().requires_grad_()
    actors = FieldActors(held, torch.zeros(1, dtype=torch.int64))
    seen = net(rays._replace(origin=origin), actors, torch.Generator().manual_seed(0))
    assert bool((seen.alpha >= 0).all() and (seen.alpha <= 1 + 1e-5).all())
    proposal = seen.proposals[0]
    more = interlevel_loss(
        seen.intervals.border, seen.intervals.weight, proposal.border, proposal.weight, 0.03
    )
    (seen.feature.square().sum() + seen.depth_m.sum() + more + proposal.depth_m.sum()).backward()
    assert all(bool(p.grad is not None and p.grad.any()) for p in net.parameters())
    for given in (origin, held.T_scene_actor):
        assert given.grad is not None
        assert bool(given.grad.any())
        assert bool(given.grad.isfinite().all())


def test_opacity_of_a_density() -> None:
    """The initial density, 0.02 / m, stops half of the light in 50 ln 2 metres."""
    found = opacity_of_density(torch.zeros(1, 1), torch.full((1, 1), 50 * math.log(2)))
    torch.testing.assert_close(found, torch.tensor([[0.5]]))


def test_a_small_field_learns_a_wall() -> None:
    """A wall 10 m ahead of beams from a metre's breadth: after 100 steps other beams end there."""
    torch.manual_seed(0)
    net = NeuralField(dataclasses.replace(SMALL, surface="density"), 0, torch.zeros(3))
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    rng = torch.Generator().manual_seed(0)

    def beams(count: int) -> tuple[FieldRays, Tensor]:
        origin = torch.rand(count, 3, generator=rng) * torch.tensor([0.0, 1, 1])
        way = torch.tensor([1.0, 0, 0]) + 0.6 * (torch.rand(count, 3, generator=rng) - 0.5)
        direction = torch.nn.functional.normalize(way, dim=-1)
        rays = FieldRays(origin, direction, torch.zeros(count), torch.full((count,), 5e-6))
        return rays, 10 / direction[:, 0]

    for _ in range(100):
        rays, range_m = beams(128)
        seen = net(rays, NOBODY, rng)
        proposal, fine = seen.proposals[0], seen.intervals
        returned = torch.ones_like(range_m, dtype=torch.bool)
        loss = interlevel_loss(fine.border, fine.weight, proposal.border, proposal.weight, 0.03)
        for part in (proposal, fine):
            loss = loss + 0.1 * beam_depth_loss(part.depth_m, range_m, returned, 150.0, 0.1)
            loss = loss + 0.3 * carving_loss(part.middle_m, part.weight, range_m, returned, 1.0, 150.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    rays, range_m = beams(200)
    with torch.no_grad():
        seen = net(rays, NOBODY)
    assert (seen.depth_m - range_m).abs().median() < 0.5
    assert (seen.median_m - range_m).abs().median() < 0.7
    assert seen.alpha.median() > 0.9


def test_decoders_give_pixels_of_three_a_side_and_beams() -> None:
    config = PatchDecoderConfig(width=8, fine_width=6, kernel=3, coarse_blocks=1, fine_blocks=1)
    torch.manual_seed(0)
    decode, feature = PatchDecoder(5, 2, 4, config), torch.randn(3, 7, 6, 5)
    image = decode(feature, torch.tensor([1, 1, 0]))
    assert image.shape == (3, 3, 21, 18)
    assert bool((image >= 0).all() and (image <= 1).all())
    decode.eval()  # batch normalisation no longer mixes the patches
    one, other = decode(feature, torch.tensor([1, 1, 0])), decode(feature, torch.tensor([1, 0, 0]))
    assert torch.equal(one[::2], other[::2])
    assert not torch.equal(one[1], other[1])
    intensity, drop_logit = BeamDecoder(5, 4)(torch.randn(9, 5))
    assert intensity.shape == drop_logit.shape == (9,)
    assert bool((intensity > 0).all() and (intensity < 1).all())


def test_a_ray_of_a_patch_stands_for_the_nine_pixels_about_it() -> None:
    """Without convolutions of several pixels, the pixels of a ray are those of its place."""
    config = PatchDecoderConfig(
        width=8, fine_width=6, kernel=1, coarse_blocks=1, fine_blocks=1, batch_norm=False
    )
    torch.manual_seed(0)
    decode, feature = PatchDecoder(5, 1, 4, config), torch.randn(1, 4, 4, 5)
    changed, camera = feature.clone(), torch.tensor([0])
    changed[0, 1, 2] += 1
    differs = (decode(feature, camera) != decode(changed, camera)).any(1)[0]
    expected = torch.zeros(12, 12, dtype=torch.bool)
    expected[3:6, 6:9] = True
    assert not bool((differs & ~expected).any())
    assert bool(differs[3:6, 6:9].all())


def test_settings_of_which_no_ray_can_be_made_are_refused() -> None:
    with pytest.raises(ValueError, match="1 proposals and 2 numbers of proposal_samples"):
        dataclasses.replace(SMALL, proposal_samples=(24, 12))
    with pytest.raises(ValueError, match="0 proposals and 0 numbers"):
        dataclasses.replace(SMALL, proposals=(), proposal_samples=())
    with pytest.raises(ValueError, match="two samples or more"):
        dataclasses.replace(SMALL, samples=1)
    with pytest.raises(ValueError, match="kernel of 4 pixels"):
        PatchDecoderConfig(kernel=4)


def test_actors_may_not_have_more_features_than_what_stands() -> None:
    with pytest.raises(ValueError, match="actors have 8 features, more than the static part's 4"):
        GridsConfig(GridConfig(2, 2, 8, 16, 10), GridConfig(4, 2, 8, 16, 10))
