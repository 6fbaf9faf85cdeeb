"""Contacts of the recording vehicle: clips that demonstrate nothing, and how long contacts are kept."""

import dataclasses
import gc
from pathlib import Path

import pytest
import synthetic_log as world
import torch

from foredrive.data import ClipConfig, ClipDataset
from foredrive.data.log_paths import find_logs
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.truth import contacts
from foredrive.scene import Trajectory, VoxelSpec

PLAN = Trajectory(
    xy=torch.tensor([[[2.0, 0.0], [3.0, 0.0]]]),
    yaw=torch.zeros(1, 2),
    valid=torch.ones(1, 2, dtype=torch.bool),
    log_prob=torch.zeros(1),
    dt_s=0.5,
)
"""A plan that stops before the box."""
STEPS = 20


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """Drive at 5 m/s through a box that stands 6 m ahead at first; the expert plans in every other frame."""
    with LogWriter(tmp_path, "flat_train", "log", [], None, None, None) as writer:
        for step in range(STEPS + 1):
            frame = world.frame(step, [])
            boxes = world.boxes(0.1 * step)
            boxes.centre[0] = torch.tensor([8.0, 0.0, 1.0]) - torch.tensor(world.driven(0.1 * step)).float()
            writer.write(dataclasses.replace(frame, boxes=boxes, expert_plan=PLAN if step % 2 == 0 else None))
    return Log(find_logs(tmp_path)[0])


@pytest.mark.parametrize(("source", "touching"), [("driven", 20), ("expert", 10)])
def test_clips_that_an_expert_teaches_do_not_count(source: str, touching: int, log: Log) -> None:
    """All 20 clips drive into the box soon after their future of 1 s. Every other one learns a plan."""
    config = ClipConfig(
        past_frames=1,
        future_frames=0,
        frame_dt_s=0.1,
        now_stride_s=0.1,
        horizon_steps=2,
        horizon_dt_s=0.5,
        image_hw=(8, 12),
        voxels=VoxelSpec((-8.0, -8.0, -1.0), 2.0, (2, 8, 8)),
        future_source=source,  # type: ignore[arg-type]
    )
    clips = ClipDataset([log.path], config, None)
    masked = [not clips.demonstration(index)[1].valid.any() for index in range(len(clips))]
    assert clips.touching == sum(masked) == touching
    if source == "expert":
        assert [clips.frames_of(index)[1][1] % 2 == 1 for index in range(len(clips))] == masked


def test_contacts_are_found_once_a_log_and_go_with_it(log: Log) -> None:
    assert not contacts.demonstrates(log, 0, 1.0)
    first = contacts._contact_us[log]
    assert not contacts.demonstrates(log, 5, 1.0)
    assert contacts._contact_us[log] is first
    gc.collect()
    kept = len(contacts._contact_us)
    for _ in range(12):
        assert not contacts.demonstrates(Log(log.path), 0, 1.0)
    gc.collect()
    assert len(contacts._contact_us) <= kept + 4  # as many as have their boxes kept
