"""Training goes on from a checkpoint as without it."""

import copy
from pathlib import Path

import pytest
import torch
from torch import nn

from foredrive.engine.checkpoints import load_checkpoint, save_checkpoint


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_the_next_fused_step_is_the_same(memory_format: torch.memory_format, tmp_path: Path) -> None:
    """Moments are saved row by row; fused Adam reads them in the order of the parameter's numbers."""
    rng = torch.Generator().manual_seed(0)
    model = nn.Conv2d(3, 4, 3).to(memory_format=memory_format)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1, fused=True)

    def step(model: nn.Conv2d, optimizer: torch.optim.Optimizer, image: torch.Tensor) -> None:
        optimizer.zero_grad()
        model(image).square().sum().backward()
        optimizer.step()

    first, second = torch.rand(2, 1, 3, 8, 8, generator=rng)
    step(model, optimizer, first)
    checkpoint = save_checkpoint(tmp_path, model, optimizer, 1)
    resumed = copy.deepcopy(model)
    again = torch.optim.Adam(resumed.parameters(), lr=0.1, fused=True)
    assert load_checkpoint(checkpoint, resumed, again) == 1
    assert resumed.weight.is_contiguous(memory_format=memory_format)
    step(model, optimizer, second)
    step(resumed, again, second)
    torch.testing.assert_close(resumed.weight, model.weight, atol=1e-6, rtol=1e-6)
