"""People whose Gaussians move in their boxes."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.edits import Duplicate, Remove, apply_edits
from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.reconstruction.training import SensorViews
from foredrive.methods.reconstruction.views import CameraView
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import RIGID, GaussianContent, gaussians_of
from foredrive.methods.splatad.deformation import REACH
from foredrive.methods.splatad.placing import place_actors
from foredrive.methods.splatad.scene import GaussianScene, saved_scene
from foredrive.methods.splatad.scene_config import GaussianSceneConfig
from foredrive.methods.splatad.training import GaussianSchedule, GaussianTraining
from foredrive.scene import Category

CONFIG = GaussianSceneConfig(deformed_people=True)


def graph_of() -> SceneGraph:
    """A car, and two people from 1 s to 3 s: one looks to the left of the scene, one ahead. A static one."""
    poses = matrix_from_yaw(
        torch.tensor([0.0, math.pi / 2, 0.0])[:, None].expand(3, 5),
        torch.tensor([[20.0, 0, 0], [10.0, 3, 0], [10.0, -3, 0]])[:, None].expand(3, 5, 3),
    )
    present = torch.ones(3, 5, dtype=torch.bool)
    present[1:, [0, 4]] = False
    people = [Category.CAR, Category.PEDESTRIAN, Category.PEDESTRIAN]
    sizes = torch.tensor([[4.0, 2, 2], [0.5, 0.8, 1.8], [0.5, 0.8, 1.6]])
    tracks = ActorTracks(
        torch.tensor([5, 7, 9]), torch.tensor(people), sizes, torch.arange(5.0), poses, present
    )
    gaussians = Gaussians(
        mean_m=torch.tensor([[0.5, 0, 0], [0.1, 0.2, -0.6], [0.1, 0.2, -0.6], [30.0, 0, 0]]),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        log_scale=torch.zeros(4, 3),
        opacity_logit=torch.zeros(4),
        feature=torch.rand(4, 5),
    )
    return SceneGraph(tracks, GaussianContent(gaussians, torch.tensor([0, 1, 2, STATIC])))


def scene_of(config: GaussianSceneConfig = CONFIG, moved: bool = True) -> GaussianScene:
    """A scene whose people move, by weights that are drawn."""
    torch.manual_seed(0)
    scene = GaussianScene(graph_of(), 1, config)
    if moved:
        assert scene.deformation is not None
        torch.nn.init.normal_(scene.deformation.layers[-1].weight, std=0.3)
    return scene


def test_people_are_rigid_at_first() -> None:
    rigid, placed = (
        place_actors(scene_of(config, moved=False).graph, 2.0).gaussians
        for config in (GaussianSceneConfig(), CONFIG)
    )
    assert torch.equal(rigid.mean_m, placed.mean_m)
    assert torch.equal(rigid.quaternion, placed.quaternion)


def test_a_shift_and_a_turn_are_in_the_axes_of_the_box() -> None:
    scene = scene_of(moved=False)
    assert scene.deformation is not None
    # Ahead by a tenth of the scale, and a small turn about the vertical axis
    scene.deformation.layers[-1].bias.data = torch.tensor([0.1, 0, 0, 0, 0, 0.02])
    still = place_actors(scene_of(GaussianSceneConfig(), moved=False).graph, 2.0).gaussians
    moved = place_actors(scene.graph, 2.0).gaussians
    shift_m = 0.1 * REACH * 0.5
    # The first person looks along y
    expected = torch.tensor([[0.0, 0, 0], [0, shift_m, 0], [shift_m, 0, 0]])
    assert torch.allclose(moved.mean_m - still.mean_m, expected, atol=1e-6)
    yaw = 2 * torch.atan2(moved.quaternion[:, 3], moved.quaternion[:, 0])
    assert yaw.tolist() == pytest.approx([0.0, math.pi / 2 + 0.02, 0.02], abs=1e-5)


def test_a_turn_comes_after_the_gaussians_own_rotation_and_before_the_actors() -> None:
    """Rotations about different axes: R_actor · R_turn · R_gaussian, which no other order gives."""
    scene = scene_of(moved=False)
    assert scene.deformation is not None
    scene.deformation.layers[-1].bias.data = torch.tensor([0.0, 0, 0, 0.3, 0, 0])
    # The Gaussians are turned by 90° about y
    half = math.sqrt(0.5)
    scene.quaternion.data = torch.tensor([[half, 0, half, 0]]).repeat(4, 1)
    placed = place_actors(scene.graph, 2.0).gaussians
    scale_free = dataclasses.replace(placed, log_scale=torch.zeros(3, 3))
    axes = scale_free.factor().permute(2, 0, 1)[1]
    about = 2 * math.atan(0.15)
    turn = torch.tensor(
        [
            [1.0, 0, 0],
            [0, math.cos(about), -math.sin(about)],
            [0, math.sin(about), math.cos(about)],
        ]
    )
    own = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    actor = scene.T_scene_actor[1, 2, :3, :3]
    assert torch.allclose(axes, actor @ turn @ own, atol=1e-5)


def test_each_person_has_a_shape_of_its_own_that_changes_with_time() -> None:
    scene = scene_of()
    own = gaussians_of(scene.graph)
    early, late = (own.shaped(own.gaussians[:3], own.actor[:3], t_s).mean_m.detach() for t_s in (1.0, 1.8))
    base_m = own.gaussians.mean_m[:3].detach()
    assert torch.equal(early[0], base_m[0])
    assert float((early[1:] - base_m[1:]).norm(dim=-1).min()) > 0.01
    assert float((early[1] - early[2]).norm()) > 0.01
    assert float((early[1:] - late[1:]).norm(dim=-1).min()) > 0.01


@pytest.mark.parametrize(("t_s", "same_s"), [(0.6, 1.4), (3.7, 2.3), (5.0, 1.0), (5.5, 1.5), (2.2, 2.2)])
def test_beyond_its_time_a_shape_goes_back_and_forth(t_s: float, same_s: float) -> None:
    own = gaussians_of(scene_of().graph)
    one, other = (own.shaped(own.gaussians[1:3], own.actor[1:3], t).mean_m for t in (t_s, same_s))
    assert torch.allclose(one, other, atol=1e-5)


def test_copies_move_as_their_source_does_and_removals_leave_the_others() -> None:
    scene = scene_of()
    before = place_actors(scene.graph, 2.0).gaussians.mean_m
    edits = [Duplicate(9, 11, offset_m=(0.0, 0.0, 1.0)), Remove(7)]
    graph = apply_edits(scene.graph, edits).graph
    after = place_actors(graph, 2.0).gaussians.mean_m
    # The car, the second person and its copy, one metre above
    assert torch.allclose(after[:2], before[[0, 2]])
    assert torch.allclose(after[2], before[2] + torch.tensor([0.0, 0, 1]), atol=1e-5)


def test_an_actor_of_another_scene_is_rigid() -> None:
    here, there = gaussians_of(scene_of().graph), gaussians_of(scene_of().graph)
    code = here.with_copy(there, 1, 3).code
    assert code is not None
    assert code.tolist() == [RIGID, 0, 1, RIGID]


def test_saved_shapes_are_read_again(tmp_path: Path) -> None:
    scene = scene_of()
    weights = {name: value.contiguous() for name, value in scene.state_dict().items()}
    save_file(weights, tmp_path / "weights.safetensors")
    read = saved_scene(tmp_path / "weights.safetensors", CONFIG, math.inf)
    read.load_state_dict(scene.state_dict())
    one, other = (place_actors(each.graph, 1.7).gaussians.mean_m for each in (scene, read))
    assert torch.equal(one, other)


def test_shapes_are_learned_from_images_at_their_own_rate() -> None:
    scene = scene_of()
    seen = CameraView(
        K=torch.tensor([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]]),
        dist=torch.zeros(5),
        T_scene_cam=torch.tensor([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
        twist_cam=torch.zeros(6),
        t_s=2.0,
        readout_s=0.0,
        sensor=0,
        size_hw=(64, 96),
        image=torch.zeros(3, 64, 96, dtype=torch.uint8),
    )
    schedule = GaussianSchedule(steps=10, max_gaussians=4)
    training = GaussianTraining(scene, SensorViews([seen], []), schedule)
    group = {group.name: group for group in training.parameter_groups()}["deformation"]
    assert group.rate == schedule.rates.deformation
    training.losses(0, torch.Generator().manual_seed(0)).losses["loss"].backward()
    # The codes, and weights and biases of three layers
    assert [parameter.grad is not None and bool(parameter.grad.any()) for parameter in group.parameters] == (
        [True] * 7
    )
    rigid = scene_of(GaussianSceneConfig(), moved=False)
    groups = GaussianTraining(rigid, SensorViews([seen], []), schedule).parameter_groups()
    assert "deformation" not in [group.name for group in groups]
