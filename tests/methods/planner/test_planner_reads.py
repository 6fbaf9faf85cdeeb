"""Gates before any long training: a planner uses what its volume holds."""

import pytest
import torch
from torch import Tensor

from foredrive.methods.planner.planner import PlannerConfig, VolumePlanner
from foredrive.scene import VoxelSpec

SPEC = VoxelSpec(lower_m=(-16.0, -24.0, -1.5), voxel_m=4.0, shape_zyx=(1, 12, 14))
CELLS = 12 * 14
CHANNELS, BATCH, STEPS, TESTED = 8, 16, 600, 100


def lit_cells(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Noise with one lit cell of 168, and its place at a quarter of the distance, m."""
    volume = 0.5 * torch.randn(BATCH, CHANNELS, *SPEC.shape_zyx, generator=generator)
    cell = torch.randint(CELLS, (BATCH,), generator=generator)
    volume.flatten(2)[torch.arange(BATCH), 0, cell] += 4.0
    return volume, 0.25 * SPEC.centres_m()[0, ..., :2].reshape(-1, 2)[cell]


@pytest.mark.slow
def test_the_decoder_finds_a_lit_cell() -> None:
    """Always naming the mean is 5 m off; places of 0.02, or dropout on the one query, learn no more."""
    torch.manual_seed(0)
    config = PlannerConfig(width=64, layers=3, heads=4, pool=(1, 1, 1), future="none")
    planner = VolumePlanner(config, SPEC, channels=CHANNELS, horizon_steps=6, dt_s=0.5)
    optimizer = torch.optim.AdamW(planner.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    generator, known = torch.Generator().manual_seed(0), torch.ones(BATCH, dtype=torch.bool)
    status = torch.zeros(BATCH, dtype=torch.long), known, torch.zeros(BATCH), known, torch.zeros(BATCH, 0, 4)
    errors_m = []
    for _ in range(STEPS):
        volume, place_m = lit_cells(generator)
        error_m = (planner(volume, None, *status).xy[:, 0, -1] - place_m).norm(dim=-1).mean()
        optimizer.zero_grad()
        error_m.backward()
        optimizer.step()
        schedule.step()
        errors_m.append(float(error_m.detach()))
    assert sum(errors_m[-TESTED:]) / TESTED < 0.1
