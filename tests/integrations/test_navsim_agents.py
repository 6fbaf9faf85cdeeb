"""Agents of NAVSIM's interface: the input that they are given, and the plan that their poses become."""

import dataclasses
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from small_drives import PAST, one_example

from foredrive.errors import InputError
from foredrive.integrations.navsim import records
from foredrive.integrations.navsim.agent import IMAGE_HW, NavsimPlanner
from foredrive.integrations.own_agents import Needs, needs_of, own_agent
from foredrive.runs.drive.agent_inputs import rig_of
from foredrive.scene import Clip, Command, LidarSweep

pytestmark = pytest.mark.usefixtures("navsim")


class Stitching(records.AbstractAgent):
    """An agent with the inputs of NAVSIM's TransFuser: three images of now, stitched, and lidar."""

    def __init__(self) -> None:
        super().__init__(records.TrajectorySampling(time_horizon=4, interval_length=0.1))

    def initialize(self) -> None:
        self.ready = True

    def get_sensor_config(self) -> records.SensorConfig:
        config = records.SensorConfig.build_no_sensors()
        config.cam_f0 = config.cam_l0 = config.cam_r0 = config.lidar_pc = [3]
        return config

    def get_feature_builders(self) -> list[Any]:
        return [self]

    def compute_features(self, agent_input: records.AgentInput) -> dict[str, torch.Tensor]:
        self.given = agent_input
        seen = agent_input.cameras[-1]
        sides = [seen.cam_l0.image, seen.cam_r0.image]  # type: ignore[list-item]
        left, right = (side[28:-28, 416:-416] for side in sides)  # type: ignore[index]
        stitched = np.concatenate([left, seen.cam_f0.image[28:-28], right], axis=1)  # type: ignore[index]
        status = agent_input.ego_statuses[-1]
        motion = np.concatenate([status.driving_command, status.ego_velocity, status.ego_acceleration])
        return {"camera": torch.tensor(stitched), "status": torch.tensor(motion)}

    def forward(self, features: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        assert features["camera"].shape == (1, 1024, 4096, 3)  # 4 : 1, as TransFuser resizes it
        assert features["status"].shape == (1, 8)
        t_s = 0.1 * torch.arange(1, 41)
        return {"trajectory": torch.stack([t_s**2, -t_s, torch.zeros_like(t_s)], dim=-1)[None]}


def navsim_clip() -> Clip:
    """Four key frames, unbatched, with the three cameras of TransFuser and five lidar points."""
    clip = one_example(3).clip[0].frames(slice(PAST - 2, PAST + 2))  # three of the past and the next
    clip = dataclasses.replace(clip, t_s=clip.t_s - clip.t_s[-1])
    frames, names = 4, ("PCAM_F0", "PCAM_L0", "PCAM_R0")
    points = torch.tensor([[4.0, 3, 0], [1, 0, 0], [0, 2, 0], [0, 0, 2], [3, 0, 4]])
    range_m = points.norm(dim=1)
    sweep = LidarSweep(
        origin_ego=torch.zeros(5, 3),
        dir_ego=points / range_m[:, None],
        range_m=range_m,
        returned=torch.tensor([True, True, True, False, True]),
        intensity=torch.full((5,), 0.2),
        dt_s=torch.zeros(5),
        beam=torch.tensor([0, 1, 2, 3, -1]),
        valid=torch.ones(5, dtype=torch.bool),
    )
    rig = clip.rig[:, [0, 0, 1]]
    return dataclasses.replace(
        clip,
        images=torch.arange(3)[None, :, None, None, None].expand(frames, 3, 3, *IMAGE_HW).to(torch.uint8),
        image_valid=torch.ones(frames, 3, dtype=torch.bool),
        rig=dataclasses.replace(rig, names=names),
        sweeps=sweep.map_tensors(lambda values: values.expand(frames, *values.shape)),
        sweep_valid=torch.ones(frames, dtype=torch.bool),
    )


def test_a_clip_becomes_navsims_input() -> None:
    agent, clip = Stitching(), navsim_clip()
    NavsimPlanner(agent).plan(clip)
    given = agent.given
    poses = np.stack([status.ego_pose for status in given.ego_statuses])
    np.testing.assert_allclose(poses[-1], 0, atol=1e-6)
    T_now = np.linalg.inv(clip.T_world_ego[-1].numpy()) @ clip.T_world_ego.numpy()
    np.testing.assert_allclose(poses[:, :2], T_now[:, :2, 3], atol=1e-5)
    turn = np.arctan2(T_now[:, 1, 0], T_now[:, 0, 0])
    np.testing.assert_allclose(poses[:, 2], turn, atol=1e-5)
    speed = float(clip.ego_speed_mps[0])
    status = given.ego_statuses[-1]
    np.testing.assert_allclose(status.ego_velocity, [speed, 0], rtol=1e-6)
    # At constant speed on a circle all acceleration is towards its centre: v times the turn rate
    np.testing.assert_allclose(status.ego_acceleration, [0, speed * -turn[-2] / 0.5], rtol=1e-4, atol=1e-5)
    assert status.driving_command.tolist() == [1, 0, 0, 0] if turn[-2] < 0 else [0, 0, 1, 0]
    # Only what the agent asks for, at the key frames that it asks for
    assert given.cameras[2].cam_f0.image is None
    assert given.cameras[3].cam_b0.image is None
    assert [int(getattr(given.cameras[3], f"cam_{name}").image.max()) for name in ("f0", "l0", "r0")] == [
        0,
        1,
        2,
    ]
    assert given.lidars[2].lidar_pc is None
    points = given.lidars[3].lidar_pc
    np.testing.assert_allclose(points[:4, 0], [4, 3, 0, 51], rtol=1e-5)
    assert points.shape == (6, 4)
    assert points[4].tolist() == [0, 1, 2, 0]


def test_each_key_frame_has_the_command_of_its_time() -> None:
    """Frames before the drive have its first one. Another drive has a memory of its own."""
    agent, whole = Stitching(), navsim_clip()
    planner, now = NavsimPlanner(agent), 3
    T_step = torch.eye(4, dtype=whole.T_world_ego.dtype)
    T_step[0, 3] = 2.0
    T = [whole.T_world_ego[0]]
    for _ in range(7):
        T.append(T[-1] @ T_step)
    names = []
    for step, command in enumerate((Command.LEFT, Command.STRAIGHT, Command.RIGHT, Command.RIGHT)):
        poses = torch.stack(T[step : step + 4])
        clip = dataclasses.replace(whole, T_world_ego=poses, command=torch.tensor(int(command)))
        planner.plan(clip)
        rows = [status.driving_command.argmax() for status in agent.given.ego_statuses]
        names.append("".join("LSRU"[row] for row in rows))
    assert names == ["LLLL", "LLLS", "LLSR", "LSRR"]
    unknown = dataclasses.replace(whole, command_valid=torch.tensor(False))
    NavsimPlanner(agent).plan(unknown)
    assert agent.given.ego_statuses[now].driving_command.tolist() == [0, 0, 0, 1]


def test_navsims_poses_become_points_of_half_seconds() -> None:
    t_s = 0.5 * np.arange(1, 7)
    points = NavsimPlanner(Stitching()).plan(navsim_clip())
    np.testing.assert_allclose(points, np.stack([t_s**2, -t_s], axis=1), atol=1e-5)
    brief = Stitching()
    brief._trajectory_sampling = records.TrajectorySampling(num_poses=40, interval_length=0.05)
    with pytest.raises(InputError, match=r"a plan of 2 s; plans are of 3 s or more"):
        NavsimPlanner(brief).plan(navsim_clip())


def test_a_navsim_agent_declares_its_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("their_agent")
    module.Stitching = Stitching  # type: ignore[attr-defined]

    class Human(Stitching):
        requires_scene = True

    module.make = Human  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "their_agent", module)
    agent = "navsim:their_agent:Stitching"
    assert needs_of(agent) == Needs(("PCAM_F0", "PCAM_L0", "PCAM_R0"), IMAGE_HW, True, 3)
    assert rig_of(agent).image_hw == IMAGE_HW
    plan = own_agent(agent).act(navsim_clip()[None])
    assert plan.xy[0, 0, -1].tolist() == pytest.approx([9.0, -3.0], abs=1e-4)


def test_an_agent_of_navsim_1_drives(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its base class needs no sampling, and a trajectory has 4 s."""
    (tmp_path / "of_v1.py").write_text(
        "from navsim.agents.abstract_agent import AbstractAgent\n"
        "from navsim.common.dataclasses import SensorConfig, Trajectory\n"
        "import numpy as np\n"
        "class Agent(AbstractAgent):\n"
        "    def __init__(self): super().__init__()\n"
        "    def initialize(self): pass\n"
        "    def get_sensor_config(self): return SensorConfig.build_no_sensors()\n"
        "    def compute_trajectory(self, given):\n"
        "        return Trajectory(np.outer(np.arange(1, 9), [2.5, 0.5, 0.0]))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plan = own_agent("navsim:of_v1:Agent").act(navsim_clip()[None])
    assert plan.xy[0, 0, [0, -1]].flatten().tolist() == pytest.approx([2.5, 0.5, 15.0, 3.0])
