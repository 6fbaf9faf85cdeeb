"""Protocols on a real drive."""

from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from foredrive.data import ClipConfig, ClipDataset, collate
from foredrive.data.formats.convert import convert
from foredrive.methods.planner.baselines import ConstantVelocity, StandStill
from foredrive.scene import Clip, VoxelSpec
from foredrive.tasks.evaluation.run import evaluate
from foredrive.tasks.planning.protocols import PROTOCOLS
from foredrive.tasks.predictor import Prediction


class GoOn:
    def predict(self, observed: Clip, asked: object) -> Prediction:
        return Prediction(plan=ConstantVelocity(6, 0.5).act(observed))


@pytest.mark.real
def test_a_real_drive_under_every_protocol(real_data: Path, tmp_path: Path) -> None:
    logs = convert(real_data / "av2" / "3b3570b4-7b0b-3268-a571-b0889dbf40b6", "av2", tmp_path)
    config = ClipConfig(
        past_frames=2,
        future_frames=6,
        image_hw=(8, 8),
        voxels=VoxelSpec((-4.0, -4.0, -1.0), 2.0, (2, 4, 4)),
        cameras=(),
        now_stride_s=2.0,
    )
    dataset = ClipDataset(logs, config, None)
    baselines = {"stand_still": StandStill(6, 0.5)}
    loader = DataLoader(dataset, batch_size=3, collate_fn=collate)
    summary = evaluate(
        GoOn(), loader, frame_dt_s=0.5, baselines=baselines, command_source=dataset.command_source
    ).summary
    assert summary["items"] == len(dataset) >= 5
    assert summary["failed"] == 0
    assert summary["command_source"] == "driven_future"
    for name in PROTOCOLS:
        key = f"planning.{name}"
        assert summary[f"{key}.frames_counted"] == len(dataset)
        assert summary[f"{key}.frames_without_boxes"] == 0
        assert 0 < summary[f"{key}.l2_1s_m"] < summary[f"{key}.l2_3s_m"] < 10.0
        assert summary[f"{key}.l2_avg_m"] < summary[f"planning.stand_still.{name}.l2_avg_m"]
    # The vehicle that was driven touched nobody: where boxes and poses go together, exact protocols say so.
    assert summary["planning.sparsedrive.driven_collision_avg_pct"] == 0.0
    assert summary["planning.bevplanner.driven_collision_avg_pct"] == 0.0
