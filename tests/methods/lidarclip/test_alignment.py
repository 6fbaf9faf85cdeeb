"""Image towers that learn by contrast; lidar that learns from images alone."""

import pytest
import torch
from torch import Tensor

from foredrive.methods.lidarclip import LidarEncoder, LidarEncoderConfig, PointCloud
from foredrive.methods.lidarclip.alignment import (
    CaptionedImages,
    ContrastConfig,
    ContrastObjective,
    DistillationObjective,
    ImagedSweeps,
)
from foredrive.methods.lidarclip.image_tower import ImageTower, ImageTowerConfig

IMAGE_TOWER = ImageTowerConfig(widths=(8, 8), depths=(1, 1), heads=2, side_px=24)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def captioned(stated: Tensor | None = None) -> CaptionedImages:
    """Two red views and two blue ones, and a text each."""
    colour = torch.tensor([0, 0, 2, 2])
    images = torch.zeros(4, 3, 40, 60, dtype=torch.uint8)
    images[torch.arange(4), colour] = 200
    return CaptionedImages(
        images=images,
        texts=torch.eye(8)[colour][:, None],
        stated=torch.eye(3).bool()[colour][:, None] if stated is None else stated,
        holds=torch.eye(3).bool()[colour],
        key=("a", "b", "c", "d"),
    )


def test_an_image_tower_learns_what_colours_are_called() -> None:
    torch.manual_seed(0)
    objective = ContrastObjective(ImageTower(IMAGE_TOWER, dim=8), ContrastConfig())
    optimizer = torch.optim.Adam(objective.parameters(), 1e-2)
    random = generator()
    for _ in range(30):  # running means of batches need some time
        loss = objective(captioned(), random)["loss"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() < 0.1
    assert all(p.grad is not None for p in objective.parameters())
    images = captioned().images[[0, 2]]
    objective.requires_grad_(False)
    found = objective.tower.eval()(images)
    assert found[0, 0] > found[0, 2]
    assert found[1, 2] > found[1, 0]
    torch.testing.assert_close(objective.tower(images[1:]), found[1:], atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ["mse", "cosine"])
def test_mirrored_sweeps_are_compared_with_mirrored_images(kind: str) -> None:
    torch.manual_seed(0)
    encoder = LidarEncoder(LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=1), dim=4).eval()
    points = torch.rand(8 * 20, 4, generator=generator()) * torch.tensor([30.0, 15.0, 3.0, 1.0])
    item = torch.arange(8).repeat_interleave(20)
    other_side = points * torch.tensor([1.0, -1.0, 1.0, 1.0])
    with torch.no_grad():
        plain, mirrored = (encoder(PointCloud(those, item), 8) for those in (points, other_side))
    assert not torch.allclose(plain, mirrored, atol=1e-3)
    off = torch.tensor([0.0, 0.0, 0.0, 3.0]) if kind == "mse" else torch.zeros(4)
    longer = 1.0 if kind == "mse" else 3.0
    batch = ImagedSweeps(
        PointCloud(points, item), torch.stack([plain, mirrored], 1) * longer + off, ("x",) * 8
    )
    losses = DistillationObjective(encoder, kind)(batch, generator())  # type: ignore[arg-type]
    assert losses["loss"].item() == pytest.approx(9 / 4 if kind == "mse" else 0, abs=1e-4)


@pytest.mark.parametrize("kind", ["mse", "cosine"])
def test_a_lidar_tower_learns_from_embeddings_without_a_text(kind: str) -> None:
    assert set(ImagedSweeps.__dataclass_fields__) == {"cloud", "targets", "key"}
    torch.manual_seed(0)
    encoder = LidarEncoder(LidarEncoderConfig(width=16, heads=2, hidden=16, blocks=2), dim=4)
    objective = DistillationObjective(encoder, kind)  # type: ignore[arg-type]
    near = torch.rand(50, 4) * torch.tensor([5.0, 5.0, 2.0, 1.0])
    cloud = PointCloud(
        torch.cat([near, near + torch.tensor([30.0, 0.0, 0.0, 0.0])]), torch.arange(2).repeat_interleave(50)
    )
    targets = torch.tensor([[2.0, 0.0, 0.0, 1.0], [0.0, 2.0, 0.0, 1.0]])[:, None].repeat(1, 2, 1)
    batch = ImagedSweeps(cloud, targets, ("a", "b"))
    optimizer, random = torch.optim.Adam(objective.parameters(), 3e-3), generator()
    for _ in range(40):
        losses = objective(batch, random)
        optimizer.zero_grad()
        losses["loss"].backward()
        optimizer.step()
    assert losses["cosine"].item() > 0.97
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in encoder.parameters())
