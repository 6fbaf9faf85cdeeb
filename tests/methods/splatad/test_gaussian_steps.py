"""Gaussians that move or are added keep what they show and begin without momentum."""

import pytest
import torch

from foredrive.methods.reconstruction.scene_graph import STATIC, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.methods.splatad.scene import GaussianScene
from foredrive.methods.splatad.training import grow, relocate


@pytest.fixture
def scene() -> GaussianScene:
    """Two dead Gaussians of an actor, a live one of it, and a live static one."""
    tracks = ActorTracks(
        torch.tensor([7]),
        torch.tensor([0]),
        torch.ones(1, 3),
        torch.tensor([0.0, 1.0]),
        torch.eye(4).repeat(1, 2, 1, 1),
        torch.ones(1, 2, dtype=torch.bool),
    )
    gaussians = Gaussians(
        mean_m=torch.arange(12.0).reshape(4, 3),
        quaternion=torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        log_scale=torch.zeros(4, 3),
        opacity_logit=torch.tensor([0.001, 0.001, 1e-2, 0.75]).logit(),
        feature=torch.rand(4, 5),
    )
    return GaussianScene(SceneGraph(tracks, GaussianContent(gaussians, torch.tensor([0, 0, 0, STATIC]))), 1)


def optimizer_of(scene: GaussianScene) -> torch.optim.Optimizer:
    """After one step of rate 0, so that it has momentum everywhere."""
    optimizer = torch.optim.Adam([scene.mean_m, scene.opacity_logit], 0.0)
    (scene.mean_m.sum() + scene.opacity_logit.sum()).backward()
    optimizer.step()
    return optimizer


def test_the_dead_join_the_living_as_parts_of_what_those_belong_to(scene: GaussianScene) -> None:
    optimizer = optimizer_of(scene)
    assert relocate(scene, optimizer, torch.Generator().manual_seed(0)) == 2
    # both go to the opaque one, which then has the opacity 1 - (1 - 0.75)^(1/3), as they have
    assert scene.actor.tolist() == [STATIC, STATIC, 0, STATIC]
    assert scene.mean_m.tolist() == [[9, 10, 11], [9, 10, 11], [6, 7, 8], [9, 10, 11]]
    opacity = scene.opacity_logit.sigmoid().detach()
    assert opacity.tolist() == pytest.approx([1 - 0.25 ** (1 / 3)] * 2 + [1e-2] + [1 - 0.25 ** (1 / 3)])
    momentum = optimizer.state[scene.mean_m]["exp_avg"].any(-1)
    assert momentum.tolist() == [False, False, True, False]
    assert relocate(scene, optimizer, torch.Generator().manual_seed(0)) == 0


def test_new_ones_share_what_the_chosen_showed(scene: GaussianScene) -> None:
    optimizer = optimizer_of(scene)
    assert grow(scene, optimizer, 5, 0.5, torch.Generator().manual_seed(0)) == 1  # not beyond 5
    assert scene.actor.tolist() == [0, 0, 0, STATIC, STATIC]
    assert scene.opacity_logit.sigmoid().detach()[3:].tolist() == pytest.approx([0.5, 0.5])
    assert scene.mean_m[4].tolist() == [9, 10, 11]
    momentum = optimizer.state[scene.mean_m]["exp_avg"].any(-1)
    assert momentum.tolist() == [True, True, True, False, False]
    assert optimizer.param_groups[0]["params"][0] is scene.mean_m
    assert grow(scene, optimizer, 5, 0.5, torch.Generator().manual_seed(0)) == 0
