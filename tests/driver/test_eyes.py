"""The eyes of a driver: frames are read at places fixed in the world, and losses see what is known alone."""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from path_truth import SPEC, sight_of, truth

from foredrive.driver.eyes import ACROSS_MPS, CameraEyes, CameraEyesConfig, FrameFeatures
from foredrive.driver.losses import SightWeights, lamp_places, sight_losses
from foredrive.driver.route_cells import BESIDE_M, HEIGHTS_M, LINE_CELLS
from foredrive.driver.sight import VELOCITY_SCALE_MPS, line_m, occupied_at_constant_velocity, scaled_line
from foredrive.driver.volume_eyes import VolumeEyes, VolumeEyesConfig
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.nemo.recipes import nemo_town
from foredrive.scene import Example, VoxelSpec
from foredrive.scene.affordances import CELLS, TIMES
from foredrive.scene.traffic_light import LightState


def eyes(frames: int = 2) -> CameraEyes:
    torch.manual_seed(0)
    return CameraEyes(CameraEyesConfig(frames=frames)).eval()


@torch.no_grad()
def test_past_frames_are_read_where_the_cells_were_then(make_example: Callable[..., Example]) -> None:
    """Features of a past frame do not depend on where the vehicle has gone since, in the world's places."""
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    network = eyes()
    features = network._features(clip)
    cells = torch.tensor([[[[5.0, 0.5], [8.0, -1.0]], [[7.0, 1.0], [12.0, 2.0]]]]).expand(2, -1, -1, -1)
    read = network._read(clip, cells, features)
    of_frame = read.shape[1] // 3  # one camera then, two at now
    # The same places, in the frame before, read as if that were now.
    T = inverse_se3(clip.T_world_ego[:, 0]) @ clip.T_world_ego[:, 1]
    before = clip.frames([0])
    for row, height in enumerate((0.4, 1.3)):
        z = torch.full((2, 4, 1), height)
        moved = transform_points(T.float(), torch.cat([cells.flatten(1, 2), z], dim=-1))[..., :2]
        again = network._read(before, moved.view(2, 2, 2, 2), features[:1])
        by_height = read[:, :of_frame].view(2, 2, -1, 2, 2)[:, row]
        expected = again.view(2, 2, -1, 2, 2)[:, row]
        torch.testing.assert_close(by_height, expected, atol=1e-4, rtol=1e-4)
        assert by_height.abs().amax() > 0.1


@torch.no_grad()
def test_a_volume_is_read_in_the_cells_of_its_frame(make_example: Callable[..., Example]) -> None:
    """The features are the places themselves: x, y and z of the volume's own frame."""
    town, spec = nemo_town().model, VoxelSpec((-8.0, -10.0, -1.5), 1.0, (5, 20, 32))
    config = VolumeEyesConfig(town, spec)
    network = VolumeEyes(config).eval()
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    places = spec.centres_m().permute(3, 0, 1, 2).expand(2, 2, -1, -1, -1, -1)
    cells = torch.tensor([[[[5.0, 0.5], [8.0, -1.0]], [[7.0, 1.0], [90.0, 2.0]]]]).expand(2, -1, -1, -1)
    read = network._read(clip, cells, places).view(2, 2, 3, 4, 2, 2)  # [b T height channel G L]
    T = inverse_se3(clip.T_world_ego[:, 0]) @ clip.T_world_ego[:, 1]
    for t, T_frame_now in enumerate((T, torch.eye(4).expand_as(T))):
        for row, height in enumerate((0.0, 1.0, 2.0)):
            points = torch.cat([cells.flatten(1, 2), torch.full((2, 4, 1), height)], dim=-1)
            moved = transform_points(T_frame_now.float(), points)
            inside = (moved[..., 0] < 24) & (moved[..., 1].abs() < 10)
            values = read[:, t, row].flatten(-2).transpose(1, 2)
            assert torch.equal(values[..., 3] > 0, inside)
            torch.testing.assert_close(values[inside][:, :3], moved[inside], atol=1e-3, rtol=0)
    assert not read[..., -1, -1].any()  # 90 m ahead


def test_frozen_eyes_train_what_reads_them_alone(make_example: Callable[..., Example]) -> None:
    spec = VoxelSpec((-8.0, -10.0, -1.5), 2.0, (3, 10, 16))
    network = VolumeEyes(VolumeEyesConfig(nemo_town().model, spec, frozen=True)).train()
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    sight_losses(network(clip), truth(), clip, SightWeights())["loss"].backward()
    assert not network.backbone.training
    moved = {
        name.split(".")[0] for name, p in network.named_parameters() if p.grad is not None and p.grad.any()
    }
    assert moved == {"reader"}


@torch.no_grad()
def test_sight_depends_on_images_and_route_but_not_on_the_speed(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    black = dataclasses.replace(clip, images=torch.zeros_like(clip.images))
    elsewhere = dataclasses.replace(clip, route_xy=clip.route_xy.flip(0))
    faster = dataclasses.replace(clip, ego_speed_mps=clip.ego_speed_mps + 3)
    for blind in (False, True):
        torch.manual_seed(0)
        network = CameraEyes(CameraEyesConfig(blind=blind)).eval()
        sight = network(clip)
        assert sight.light_logits.shape == (2, 4)
        assert torch.equal(sight.light_logits[:, 1:], sight.lamp_logits.amax((1, 3, 4)))
        assert torch.equal(network(black).occupied_logits, sight.occupied_logits) is blind
        assert not torch.allclose(network(elsewhere).occupied_logits, sight.occupied_logits)
        assert not torch.allclose(network(elsewhere).lamp_logits, sight.lamp_logits)
        assert torch.equal(network(faster).occupied_logits, sight.occupied_logits)
        assert torch.equal(network(faster).light_logits, sight.light_logits)


def test_a_clip_of_other_cameras_or_too_few_frames_is_refused(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=1, past=0, future=0, cameras=2).clip
    with pytest.raises(InputError, match="2 key frames cannot see a clip of 2 cameras and 1 key frames"):
        eyes()(clip)


def test_the_distance_of_a_line_is_read_at_the_lamp() -> None:
    distance_m = torch.tensor([-2.9, 0.0, 10.0, 60.0])
    torch.testing.assert_close(line_m(scaled_line(distance_m)), distance_m)
    lamps, lines = torch.full((1, 2, 3, 2, 3), -4.0), torch.zeros(1, 2, 2, 3)
    lamps[0, 1, 2, 1, 0] = 3.0  # green, in the second camera
    lines[0, 1, 1, 0] = scaled_line(torch.tensor(17.0))
    sight = dataclasses.replace(sight_of(1, size=(2, 3)), lamp_logits=lamps, lamp_line=lines)
    torch.testing.assert_close(sight.light_m, torch.tensor([17.0]))


def test_the_distance_of_a_line_is_read_on_the_ground_where_one_is_seen() -> None:
    logits = torch.full((4, LINE_CELLS + 1), -20.0)
    logits[0, 0] = 5.0  # in the first cell
    logits[1, [7, 8]] = 5.0  # on the border of two cells, 8 m ahead
    logits[2, [11, 12, 13]] = torch.tensor([0.25, 0.5, 0.25]).log() + 5
    logits[2, -1] = 4.0  # maybe none
    logits[3, [5, 20, 40]] = 5.0  # not in one place
    lamp_line = torch.full((4, 2, 8, 16), float(scaled_line(torch.tensor(30.0))))
    sight = dataclasses.replace(sight_of(4), line_logits=logits, lamp_line=lamp_line)
    assert sight.line_seen.tolist() == [True, True, True, False]
    torch.testing.assert_close(sight.light_m, torch.tensor([0.5, 8.0, 12.5, 30.0]), atol=1e-3, rtol=0)


def test_the_line_is_learned_where_it_is(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    known = truth(5)
    known = dataclasses.replace(
        known,
        light=torch.tensor([1, 2, 3, 0, 1]),
        light_m=torch.tensor([5.5, 1.5, 50.0, 0.0, 5.5]),
        light_known=torch.tensor([True, True, True, True, False]),
    )
    sight = dataclasses.replace(sight_of(5), line_logits=torch.zeros(5, LINE_CELLS + 1, requires_grad=True))
    clip = clip[torch.tensor([0, 1, 0, 1, 0])]
    sight_losses(sight, known, clip, SightWeights())["line"].backward()
    grad = sight.line_logits.grad
    assert (grad < 0).nonzero().tolist() == [[0, 5], [1, LINE_CELLS], [2, LINE_CELLS], [3, LINE_CELLS]]


def test_the_line_of_a_sign_is_learned_where_it_is(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    known = dataclasses.replace(truth(2), sign=torch.tensor([True, False]), sign_m=torch.tensor([9.5, 0.0]))
    sight = dataclasses.replace(sight_of(2), sign_logits=torch.zeros(2, LINE_CELLS + 1, requires_grad=True))
    sight_losses(sight, known, clip, SightWeights())["sign"].backward()
    assert (sight.sign_logits.grad < 0).nonzero().tolist() == [[0, 9], [1, LINE_CELLS]]


@torch.no_grad()
def test_eyes_without_signs_see_none(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    torch.manual_seed(0)
    with_signs = CameraEyes(CameraEyesConfig(signs=True)).eval()
    assert torch.isinf(eyes()(clip).sign_m).all()
    black = dataclasses.replace(clip, images=torch.zeros_like(clip.images))
    assert not torch.allclose(with_signs(clip).sign_logits, with_signs(black).sign_logits)
    logits = torch.full((2, LINE_CELLS + 1), -20.0)
    logits[0, 8], logits[1, -1] = 5.0, 5.0
    seen = dataclasses.replace(sight_of(2), sign_logits=logits).sign_m
    assert seen.tolist() == [pytest.approx(8.5), float("inf")]


@torch.no_grad()
def test_the_ground_is_read_along_the_route(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    network = eyes()
    black = dataclasses.replace(clip, images=torch.zeros_like(clip.images))
    assert not torch.allclose(network(clip).line_logits, network(black).line_logits)
    turned = dataclasses.replace(clip, route_xy=clip.route_xy.flip(0))
    assert not torch.allclose(network(clip).line_logits, network(turned).line_logits)
    then = dataclasses.replace(clip, images=torch.cat([clip.images[:, :1] * 0, clip.images[:, 1:]], dim=1))
    assert torch.equal(network(clip).line_logits, network(then).line_logits)  # which tells who stands


def test_lamps_are_learned_in_place_and_unknown_cells_not_at_all(
    make_example: Callable[..., Example],
) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    rig, known = clip.rig[:, clip.now], truth()
    hidden = known.occupied_known.clone()
    hidden[0] = False
    known = dataclasses.replace(known, occupied_known=hidden)
    h, w = 8, 16
    sight = sight_of(2, size=(h, w))
    for field in dataclasses.fields(sight):
        getattr(sight, field.name).requires_grad_()
    places = lamp_places(known, rig, (h, w))
    assert places.inside.nonzero().tolist() == [[0, 0, 0], [1, 0, 0]]  # the front camera sees the first lamp
    losses = sight_losses(sight, known, clip, SightWeights())
    torch.testing.assert_close(losses["loss"], sum(v for k, v in losses.items() if k != "loss"))
    losses["loss"].backward()
    wanted = (sight.lamp_logits.grad < 0).nonzero().tolist()
    row, column = int(places.row[0, 0, 0]), int(places.column[0, 0, 0])
    assert wanted == [[item, 0, LightState.RED - 1, row, column] for item in (0, 1)]
    assert (sight.lamp_line.grad != 0).nonzero().tolist() == [[item, 0, row, column] for item in (0, 1)]
    assert not sight.occupied_logits.grad[0].any()
    now, later = sight.occupied_logits.grad[1, 0, 4], sight.occupied_logits.grad[1, 2, 4]
    assert later < 0 < now
    assert float(-later / now) == pytest.approx(5.0)  # occupied, and later only: 2.5 × 2


def test_a_light_that_no_image_shows_is_not_learned(make_example: Callable[..., Example]) -> None:
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    known = dataclasses.replace(truth(), lamp=torch.tensor([[False, True], [True, True]]))
    logits = torch.zeros(2, 4, requires_grad=True)
    sight_losses(sight_of(2, logits), known, clip, SightWeights())["light"].backward()
    assert not logits.grad[0].any()
    assert logits.grad[1, LightState.RED] < 0


def test_road_users_that_go_on_as_they_move_come_into_the_way() -> None:
    """A cyclist 8.5 m to the left of cell 3 rides to the right at 4 m/s and forward at 1 m/s; one stands."""
    users = torch.full((2, 4, CELLS, len(BESIDE_M)), -20.0)
    users[:, 2:] = 0.0
    rides = users[1, :, 3, BESIDE_M.index(8.5)]
    rides[1], rides[2], rides[3] = 3.0, 1.0 / VELOCITY_SCALE_MPS, -4.0 / VELOCITY_SCALE_MPS
    users[1, 0, 10, BESIDE_M.index(0.8)] = 2.0
    occupied = occupied_at_constant_velocity(users.requires_grad_())
    p = torch.tensor([3.0, 2.0]).sigmoid()
    assert float(occupied[0].detach().max()) < 1e-6
    # 8.5, 6.5, 4.5, 2.5, 0.5, -1.5, -3.5 m beside: a share of 0.13, all, and 0.8 from 1.5 s to 2.5 s.
    shares = {3: (1 - 1.3 / 1.5, 4), 4: (1.0, 4), 5: (1 - 0.3 / 1.5, 4)}
    for step in range(TIMES):
        wanted = torch.zeros(CELLS)
        wanted[10] = p[1]
        if step in shares:
            share, cell = shares[step]
            wanted[cell] = share * p[0]
        torch.testing.assert_close(occupied[1, step].detach(), wanted, atol=1e-5, rtol=0)
    occupied[1, 4, 4].backward()
    assert users.grad[1, 1, 3, BESIDE_M.index(8.5)] > 0


@torch.no_grad()
def test_what_moves_across_looks_as_it_did_where_it_was(make_example: Callable[..., Example]) -> None:
    """A patch moves to the right at 2.5 m/s, seen from a vehicle that drives and turns; all else is plain."""
    clip = make_example(spec=SPEC, batch=2, past=1, future=0, cameras=2).clip
    network = eyes()
    network.narrow[0].weight.copy_(torch.eye(16, 32)[..., None, None])
    network.narrow[0].bias.zero_()
    cells = torch.tensor([[[12.0, -4.0], [12.0, 0.0], [12.0, 4.0]]]).expand(2, 1, -1, -1)
    left = torch.tensor([0.0, 1.0, 0.0])
    dt_s = float(clip.t_s[0, 1] - clip.t_s[0, 0])
    features = []
    for t in (0, 1):
        place = torch.tensor([12.0, 0.0, HEIGHTS_M[1]]) + (1 - t) * dt_s * 2.5 * left
        T_frame_now = (inverse_se3(clip.T_world_ego[:, t]) @ clip.T_world_ego[:, 1]).float()
        at = transform_points(T_frame_now, place.expand(2, 1, 3))
        rig = clip.rig[:, t]
        in_camera = transform_points(inverse_se3(rig.T_ego_cam[:, 0]), at)
        uv, _, inside = project(in_camera, rig.K[:, 0], rig.dist[:, 0], rig.size_hw)
        assert inside.all()
        fine = torch.zeros(2, 2, 32, 64, 96)
        fine[:, :, 0] = 1.0  # what all else looks like
        for item in (0, 1):
            scale = torch.tensor([96.0, 64.0]) / torch.tensor(rig.size_hw[::-1])
            column, row = (uv[item, 0] * scale).long().tolist()
            patch = torch.tensor([0.0, 1.0])[:, None, None]
            fine[item, 0, :2, row - 1 : row + 2, column - 1 : column + 2] = patch
        features.append(FrameFeatures(fine[:, : 1 + t], torch.zeros(2, 1 + t, 48, 4, 6)))
    cosines = network._motion(clip, cells, features).view(2, 2, len(ACROSS_MPS), 3)[:, 1, :, 1]
    assert cosines.argmax(-1).tolist() == [ACROSS_MPS.index(-2.5)] * 2
    assert (cosines.amax(-1) > 0.8).all()
    assert (cosines[:, ACROSS_MPS.index(0.0)] < 0.3).all()
