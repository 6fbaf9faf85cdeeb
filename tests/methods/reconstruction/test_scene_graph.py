"""Actors and their Gaussians at any moment, by hand."""

import dataclasses
import math
from collections.abc import Iterator

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.geometry.se3 import exp_se3, matrix_from_yaw
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import (
    ActorTracks,
    joined_tracks,
    move_at_least,
    split_tracks,
    states_at,
)
from foredrive.methods.splatad import Gaussians, project_camera
from foredrive.methods.splatad.content import GaussianContent, gaussians_of
from foredrive.methods.splatad.placing import mirrored, place_actors, project_scene
from foredrive.ops.splatting import Splats
from foredrive.scene import Category


def two_actors() -> ActorTracks:
    """A car that turns left by 90° over 2 s and goes from (0, 0) to (4, 0), and a person who comes late."""
    turning = matrix_from_yaw(torch.tensor([0.0, math.pi / 2]), torch.tensor([[0.0, 0, 1], [4.0, 0, 1]]))
    late = matrix_from_yaw(torch.zeros(2), torch.tensor([[0.0, 9, 0], [0.0, 9, 0]]))
    return ActorTracks(
        track_id=torch.tensor([7, 11]),
        category=torch.tensor([Category.CAR, Category.PEDESTRIAN]),
        size_lwh=torch.tensor([[4.0, 2, 2], [1, 1, 2]]),
        t_s=torch.tensor([0.0, 2.0]),
        T_scene_actor=torch.stack([turning, late]),
        present=torch.tensor([[True, True], [False, True]]),
    )


def graph_of(mean_m: list[list[float]], actor: list[int], tracks: ActorTracks) -> SceneGraph:
    count = len(actor)
    gaussians = Gaussians(
        mean_m=torch.tensor(mean_m),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scale=torch.tensor([[1.0, 0.1, 0.2]]).log().repeat(count, 1),
        opacity_logit=torch.zeros(count),
        feature=torch.arange(count * 3.0).reshape(count, 3),
    )
    return SceneGraph(tracks, GaussianContent(gaussians, torch.tensor(actor)))


def covariance(gaussians: Gaussians) -> torch.Tensor:
    M = gaussians.factor().permute(2, 0, 1)
    return M @ M.transpose(-1, -2)


def test_halfway_an_actor_has_gone_and_turned_half() -> None:
    states = states_at(two_actors(), 1.0)
    assert torch.allclose(states.T_scene_actor[0, :3, 3], torch.tensor([2.0, 0, 1]))
    c = math.sqrt(0.5)
    assert torch.allclose(states.T_scene_actor[0, :2, :2], torch.tensor([[c, -c], [c, c]]), atol=1e-6)
    assert torch.allclose(states.velocity_mps[0], torch.tensor([2.0, 0, 0]))
    assert torch.allclose(states.turn_radps[0], torch.tensor([0, 0, math.pi / 4]), atol=1e-6)
    assert states.present.tolist() == [True, False]


def test_an_actor_on_its_side_turns_about_the_axis_of_the_scene() -> None:
    """Rolled by 90° to the right, it turns left in its own axes by 90° over 2 s: about the scene's y."""
    rolled = exp_se3(torch.tensor([0.0, 0, 0, -math.pi / 2, 0, 0]))
    turned = rolled @ matrix_from_yaw(torch.tensor(math.pi / 2), torch.zeros(3))
    poses = torch.stack([torch.stack([rolled, turned]), two_actors().T_scene_actor[1]])
    tracks = dataclasses.replace(two_actors(), T_scene_actor=poses)
    turn_radps = states_at(tracks, 1.0).turn_radps[0]
    assert torch.allclose(turn_radps, torch.tensor([0, math.pi / 4, 0]), atol=1e-6)


def test_an_actor_goes_on_for_one_step_and_no_longer() -> None:
    states = states_at(two_actors(), 3.0)
    assert torch.allclose(states.T_scene_actor[0, :3, 3], torch.tensor([6.0, 0, 1]), atol=1e-6)
    assert bool(states.present[0])
    assert not bool(states_at(two_actors(), 4.5).present[0])


def test_time_and_poses_have_gradients() -> None:
    offset = torch.zeros(2, 2, 6, requires_grad=True)
    t_s = torch.tensor(1.0, requires_grad=True)
    x = states_at(two_actors().moved(offset), t_s).T_scene_actor[0, 0, 3]
    x.backward()
    assert t_s.grad is not None
    assert float(t_s.grad) == pytest.approx(2.0)
    assert offset.grad is not None
    # the second key pose looks along y: what is to its right is further along x
    assert torch.allclose(offset.grad[0, :, :2], torch.tensor([[0.5, 0], [0, -0.5]]), atol=1e-6)


def test_gaussians_turn_and_move_with_their_actor() -> None:
    graph = graph_of([[5.0, 5, 5], [2.0, 0, 0], [0.0, 0, 0]], [STATIC, 0, 1], two_actors())
    placed = place_actors(graph, 2.0)
    assert placed.source.tolist() == [1]  # the late one is not there between the key times
    assert torch.allclose(placed.gaussians.mean_m, torch.tensor([[4.0, 2, 1]]), atol=1e-6)
    turned = torch.diag(torch.tensor([0.1, 1.0, 0.2]) ** 2)
    assert torch.allclose(covariance(placed.gaussians)[0], turned, atol=1e-6)
    # 2 m in front of the middle, which turns by π/4 a second: at its left, which is -x now
    expected = torch.tensor([[2 - math.pi / 2, 0, 0]])
    assert torch.allclose(placed.velocity_mps, expected, atol=1e-5)


def test_velocities_are_those_of_the_poses() -> None:
    graph = graph_of([[1.0, 0.5, 0.2]], [0], two_actors())
    before, after = place_actors(graph, 0.999), place_actors(graph, 1.001)
    measured = (after.gaussians.mean_m - before.gaussians.mean_m) / 0.002
    assert torch.allclose(place_actors(graph, 1.0).velocity_mps, measured, atol=2e-3)


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_gradients_of_poses_have_the_same_bits_every_time() -> None:
    """Thousands of Gaussians add up to the gradient of one pose, in whatever order threads come."""
    spots = torch.randn(30_000, 3, generator=torch.Generator().manual_seed(0))
    graph, offset = graph_of(spots.tolist(), [0] * len(spots), two_actors()), torch.zeros(2, 2, 6)
    offset.requires_grad_()

    def gradient() -> torch.Tensor:
        placed = place_actors(dataclasses.replace(graph, tracks=graph.tracks.moved(offset)), 0.7)
        change = (
            placed.gaussians.mean_m.sin() * placed.velocity_mps
        ).sum() + placed.gaussians.quaternion.sum()
        return torch.autograd.grad(change, offset)[0]

    first = gradient()
    assert float(first.abs().max()) > 0
    assert all(torch.equal(gradient(), first) for _ in range(5))


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: sum(x * x for x in q) > 0.1))
def test_mirroring_is_a_reflection_of_place_and_shape(q: list[float]) -> None:
    graph = graph_of([[1.0, 0.5, 0.2]], [0], two_actors())
    gaussians = dataclasses.replace(gaussians_of(graph).gaussians, quaternion=torch.tensor([q]))
    M = torch.diag(torch.tensor([1.0, -1, 1]))
    other = mirrored(gaussians)
    assert torch.allclose(other.mean_m, gaussians.mean_m @ M)
    assert torch.allclose(covariance(other), M @ covariance(gaussians) @ M, atol=1e-5)


def test_only_the_actors_that_are_named_are_mirrored() -> None:
    graph = graph_of([[0.0, 1, 0], [0.0, 1, 0]], [0, STATIC], two_actors())
    placed = place_actors(graph, 0.0, mirror=torch.tensor([True, False]))
    assert torch.allclose(placed.gaussians.mean_m, torch.tensor([[0.0, -1, 1]]))


def test_vehicles_look_alike_from_both_sides_and_people_do_not() -> None:
    assert two_actors().mirrored.tolist() == [True, False]


def test_an_unknown_actor_is_told_with_those_there_are() -> None:
    with pytest.raises(InputError, match=r"no actor 3; there are: 7, 11"):
        two_actors().index_of(3)


def walkers() -> ActorTracks:
    """Three cars and a person over four key times: one stands, one creeps, one drives, the person walks.

    At ±0.3 and ±0.9 m the standard deviation is √(1.8 / 3) = 0.775 m; a half of that for what creeps. The car
    that stands is far from where it would be put by its undefined first pose, which does not count.
    """
    way = torch.tensor([-0.9, -0.3, 0.3, 0.9])
    ahead = torch.stack([0 * way, 0.5 * way, way, way])
    centre = torch.stack([ahead + torch.tensor([[50.0], [0], [0], [0]]), 0 * ahead, 0 * ahead], dim=-1)
    poses = matrix_from_yaw(torch.zeros(4, 4), centre)
    poses[0, 0] = torch.eye(4)
    present = torch.ones(4, 4, dtype=torch.bool)
    present[0, 0] = False
    category = torch.tensor([Category.CAR, Category.CAR, Category.CAR, Category.PEDESTRIAN])
    return ActorTracks(torch.tensor([2, 3, 5, 8]), category, torch.ones(4, 3), way + 1, poses, present)


@pytest.mark.parametrize(
    ("moves_m", "nonrigid", "actors"),
    [
        (0.5, True, [5, 8]),
        (0.5, False, [5]),
        (0.38, False, [3, 5]),
        (0.8, True, []),
        (0.0, True, [2, 3, 5, 8]),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 0.8])
def test_what_moves_is_an_actor_in_whatever_direction(
    moves_m: float, nonrigid: bool, actors: list[int], yaw: float
) -> None:
    tracks = walkers()
    T = matrix_from_yaw(torch.tensor(yaw), torch.tensor([500.0, -300, 0]))
    tracks = dataclasses.replace(tracks, T_scene_actor=T @ tracks.T_scene_actor)
    own, obstacles = split_tracks(tracks, moves_m, nonrigid)
    assert own.track_id.tolist() == actors
    assert sorted([*actors, *obstacles.track_id.tolist()]) == [2, 3, 5, 8]
    assert torch.equal(joined_tracks(own, obstacles).track_id.sort().values, tracks.track_id)


def test_what_was_met_once_stands() -> None:
    tracks = walkers()
    once = dataclasses.replace(tracks, present=torch.tensor([[False, False, True, False]]).expand(4, 4))
    assert not bool(move_at_least(once, 0.01).any())


def test_a_scene_is_projected_in_two_parts() -> None:
    """The static part where it is, 5 m in front of the camera; then the actor, which is turned and moves."""
    graph = graph_of([[2.0, 0, 0], [0.5, 0.2, 5], [0.0, 0, 0]], [0, STATIC, 1], two_actors())
    K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    T_cam_scene = torch.eye(4)
    T_cam_scene[2, 3] = 1.0

    def project(
        gaussians: Gaussians, velocity_mps: torch.Tensor | None, among: torch.Tensor | None
    ) -> Splats:
        return project_camera(
            gaussians, T_cam_scene, K, torch.zeros(5), (100, 100), velocity_mps=velocity_mps, among=among
        )

    splats = project_scene(graph, 1.0, None, project)
    with torch.no_grad():
        drawn = project_scene(graph, 1.0, None, project)
    # The static one at depth 6; that of the actor is 1.41 m along both axes from its middle (2, 0, 1)
    assert splats.range_m.tolist() == pytest.approx([6.0, 2.0])
    aside_m = 2 * math.sqrt(0.5)
    expected = [50 + 50 * (2 + aside_m), 50 + 50 * aside_m]
    assert splats.mean[1].tolist() == pytest.approx(expected, rel=1e-5)
    assert splats.velocity[0].tolist() == [0.0, 0.0]
    assert float(splats.velocity[1].abs().max()) > 0
    for one, other in zip(drawn, splats, strict=True):
        torch.testing.assert_close(one, other.detach())
    # After the log only the static part is there
    assert len(project_scene(graph, 9.0, None, project).mean) == 1
