"""Fitting what is read along a path: it finds what matters, and learns nothing from what is not known."""

import dataclasses

import pytest
import torch

from foredrive.methods.planner.path_correction import PathCorrection, PathCorrectionConfig, PathSamples
from foredrive.methods.planner.path_fit import PathDemonstrations, PathFit, fit_path
from foredrive.scene import VoxelSpec

SPEC = VoxelSpec(lower_m=(0.0, 0.0, 0.0), voxel_m=1.0, shape_zyx=(1, 4, 4))
COUNT, DISTANCES = 400, (2.0, 6.0)


def correction() -> PathCorrection:
    torch.manual_seed(0)
    config = PathCorrectionConfig(distances_m=DISTANCES, width=32, hidden=16)
    return PathCorrection(config, SPEC, channels=2, status=1, steps=2)


@pytest.fixture(scope="module")
def shown() -> PathDemonstrations:
    """Who has the first feature at the second distance, on the path, stops 1 m short in each step."""
    generator = torch.Generator().manual_seed(0)
    values = 5 + 3 * torch.randn(COUNT, len(DISTANCES), 3, 2, generator=generator)
    blocked = values[:, 1, 1, 0] > 5
    unseen = torch.tensor([[2.0, 0.0], [4.0, 0.0]]).expand(COUNT, 2, 2)
    short = torch.tensor([[1.0, 0.0], [2.0, 0.0]]) * blocked[:, None, None]
    return PathDemonstrations(
        values=values.half(),
        positions_m=torch.zeros(COUNT, len(DISTANCES), 3, 2),
        status=torch.zeros(COUNT, 1),
        planned_xy=unseen,
        driven_xy=unseen - short,
        valid=torch.ones(COUNT, 2, dtype=torch.bool),
    )


def errors_m(path: PathCorrection, shown: PathDemonstrations) -> torch.Tensor:
    with torch.no_grad():
        change = path(PathSamples(shown.values, shown.positions_m), shown.status).cumsum(dim=1)
    return (shown.planned_xy + change - shown.driven_xy).norm(dim=-1)


def test_it_finds_what_the_plan_depends_on(shown: PathDemonstrations) -> None:
    path = correction()
    before = errors_m(path, shown).mean()
    fit_path(path, shown, PathFit(steps=300), seed=0)
    assert errors_m(path, shown).mean() < 0.35 * before
    torch.testing.assert_close(path.mean, shown.values.float().mean(dim=(0, 1, 2)))
    assert not path.training
    again = correction()
    fit_path(again, shown, PathFit(steps=300), seed=0)
    assert torch.equal(errors_m(again, shown), errors_m(path, shown))


def test_steps_that_are_not_known_teach_nothing(shown: PathDemonstrations) -> None:
    nonsense = dataclasses.replace(
        shown,
        driven_xy=torch.cat([shown.driven_xy[:, :1], torch.full((COUNT, 1, 2), torch.nan)], dim=1),
        valid=torch.tensor([True, False]).expand(COUNT, 2),
    )
    path = correction()
    fit_path(path, nonsense, PathFit(steps=100), seed=0)
    first_m = errors_m(path, shown)[:, 0]
    assert first_m.isfinite().all()
    assert first_m.mean() < 0.45
