"""The first losses of a miniature run, as they were when they were last looked at: a changed formula shows.

After a change that is meant to change them, write them anew and look at the difference:

    FOREDRIVE_WRITE_GOLDEN=1 .venv/bin/python -m pytest tests/runs/test_golden.py && git diff tests/runs

The committed numbers hold on any CPU: the log is written from closed forms, the order of data, the rays and
the first weights come from seeded generators, and dropout, whose random bits differ between builds of torch,
is off. What is left is the rounding of sums: other instruction sets and numbers of threads change these
losses by up to 6e-6 of themselves. A warp by the inverse motion changes them by 1e-2, rays that are off by
half a voxel by 1e-3.
"""

import dataclasses
import json
import os
from pathlib import Path

import pytest
import torch
from lightning_fabric import Fabric
from miniature import miniature, with_steps

from foredrive.data import ClipDataset, LogPath, collate
from foredrive.engine.loop import train
from foredrive.engine.metrics_log import read_metrics
from foredrive.runs.build import build_agent, build_objective

GOLDEN = Path(__file__).with_name("golden.json")
RTOL = 3e-4
SPREAD = 0.3
"""Of what is added to the weights: fresh ones predict no motion and much the same everywhere, which would
hide mistakes."""
LR = 1e-4
"""Small, so that Adam does not blow up the rounding of sums."""


def first_losses(log: LogPath, folder: Path) -> dict[str, list[dict[str, float]]]:
    """Five steps of pre-training and three of fine-tuning."""
    recipe = with_steps(miniature(), pretrain=5, finetune=3)
    dataset = ClipDataset([log], recipe.clips, cache_dir=None)
    torch.manual_seed(0)
    agent = build_agent(recipe)
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter += SPREAD * torch.randn_like(parameter)
    for module in agent.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
        elif isinstance(module, torch.nn.MultiheadAttention):
            module.dropout = 0.0
    found = {}
    for name, stage in (("pretrain", recipe.pretrain), ("finetune", recipe.finetune)):
        objective = build_objective(recipe, stage, agent)
        fabric = Fabric(accelerator="cpu", devices=1)
        schedule = dataclasses.replace(stage.schedule, lr=LR)
        train(objective, dataset, collate, schedule, folder / name, fabric)
        lines = read_metrics(folder / name / "metrics.jsonl")
        found[name] = [
            {key: value for key, value in line.items() if key not in ("step", "step_s", "cpu_s")}
            for line in lines
        ]
    return found


def test_the_first_losses_are_what_they_were(log: LogPath, tmp_path: Path) -> None:
    found = first_losses(log, tmp_path)
    if os.environ.get("FOREDRIVE_WRITE_GOLDEN"):
        GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
    golden = json.loads(GOLDEN.read_text())
    assert {stage: len(lines) for stage, lines in golden.items()} == {"pretrain": 5, "finetune": 3}
    for stage, lines in golden.items():
        for step, (now, then) in enumerate(zip(found[stage], lines, strict=True), start=1):
            assert now == pytest.approx(then, rel=RTOL), f"{stage}, step {step}"
