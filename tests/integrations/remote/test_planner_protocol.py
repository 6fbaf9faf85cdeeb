"""Neuro-ncap's model server protocol: both of our sides, and a server that reads messages as UniAD's does."""

import base64
import dataclasses
import io
import math
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from foredrive.data.batches import stack_records
from foredrive.data.boxes import no_boxes
from foredrive.data.lidar import empty_sweep
from foredrive.driving.observation import KeyFrame, make_clip
from foredrive.driving.plans import waypoints_of
from foredrive.driving.simple_agents import plan_of
from foredrive.errors import InputError
from foredrive.integrations.remote.planner_client import HttpPlanner, check_planner
from foredrive.integrations.remote.planner_messages import PlannerInput, T_ego_lidar, canbus, planner_input
from foredrive.integrations.remote.planner_server import PlannerNeeds, PlannerService
from foredrive.integrations.remote.sent_tensors import decode_image, encode_tensors
from foredrive.json_http import Address
from foredrive.json_server import JsonServer
from foredrive.scene import CameraRig, Clip, Command, LidarSweep, Trajectory

YAW = 0.5
PLAN = [[1.0, 0.1], [2.0, 0.2], [3.0, 0.4], [4.0, 0.7], [5.0, 1.1], [6.0, 1.6]]


def sweep() -> LidarSweep:
    one = torch.tensor([1.0, 0.0])
    return dataclasses.replace(
        empty_sweep(),
        origin_ego=torch.tensor([[1.1, 0.2, 1.9]]).expand(2, 3),
        dir_ego=torch.tensor([[1.0, 0.0, 0.0]]).expand(2, 3),
        range_m=5 * one,
        returned=one.bool(),
        intensity=0.5 * one,
        dt_s=-0.05 * one,
        beam=torch.tensor([3, 4]),
        valid=torch.ones(2, dtype=torch.bool),
    )


def rig() -> CameraRig:
    T = torch.eye(4)
    T[:3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T[0, 3] = 1.7
    K = torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 3.0], [0.0, 0.0, 1.0]])
    return CameraRig(
        torch.stack([K, torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ K]),
        T.repeat(2, 1, 1),
        torch.zeros(2, 5),
        torch.zeros(2),
        ("PCAM_F0", "PCAM_B0"),
        (6, 8),
    )


def observation(first_s: float = -1.0, last_s: float = 0.0) -> Clip:
    """Key frames of a vehicle that turns left at 4 m/s and then 5 m/s; each camera has its own colour."""
    frames = []
    for index, t_s in enumerate(np.arange(first_s, last_s + 0.1, 0.5).tolist()):
        yaw, T = YAW + 0.1 * index, np.eye(4)
        T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
        T[:3, 3] = 400.0 + index, -30.0, 2.0
        images = torch.full((2, 3, 6, 8), 10 * index, dtype=torch.uint8)
        images[:, 1] = torch.tensor([7, 9])[:, None, None]
        frames.append(KeyFrame(t_s, T, 4.0 + index, images, sweep(), no_boxes()))
    return make_clip(frames, rig(), Command.LEFT)


class Recorder:
    """A model server that notes what it is asked, and answers a plan."""

    def __init__(self, plan: object = PLAN) -> None:
        self.resets, self.asked, self.plan = 0, list[Any](), plan

    def reset(self, _: object) -> object:
        self.resets += 1
        return True

    def infer(self, body: object) -> object:
        self.asked.append(body)
        return {"trajectory": self.plan, "aux_outputs": {"object_ids": None}}

    def served(self) -> JsonServer:
        return JsonServer(
            {
                ("GET", "/alive"): lambda _: True,
                ("POST", "/reset"): self.reset,
                ("POST", "/infer"): self.infer,
            }
        )


def test_a_planner_is_reset_primed_and_asked_once_per_key_frame() -> None:
    server, now_s = Recorder(), [0.0]
    with server.served().in_background() as address:
        check_planner(address)
        planner = HttpPlanner(address, lambda: now_s[0])
        plan = planner.act(stack_records([observation(-1.0, 0.0)]))
        assert (server.resets, len(server.asked)) == (1, 3)
        now_s[0] = 0.5
        planner.act(stack_records([observation(-1.0, 0.0)]))
    assert (server.resets, len(server.asked)) == (1, 4)
    np.testing.assert_allclose(waypoints_of(plan), PLAN, atol=1e-6)
    times = np.diff([asked["timestamp"] for asked in server.asked])
    assert times.tolist() == [500_000] * 3
    assert all(asked["timestamp"] > 0 for asked in server.asked)


def test_messages_are_read_as_uniad_reads_them() -> None:
    """The steps of UniAD's `inference/server.py`: images, projections from the lidar frame, signals."""
    server = Recorder()
    with server.served().in_background() as address:
        HttpPlanner(address, lambda: 0.0).act(stack_records([observation()]))
    asked = server.asked[-1]
    assert set(asked) == {"images", "ego2world", "canbus", "timestamp", "command", "calibration"}
    assert set(asked["images"]) == {"CAM_FRONT", "CAM_BACK"}
    data = io.BytesIO(base64.b64decode(asked["images"]["CAM_BACK"]))
    image = torch.load(data, weights_only=True)
    assert (image.dtype, tuple(image.shape)) == (torch.uint8, (6, 8, 3))
    assert image[0, 0].tolist() == [20, 9, 20]
    assert asked["command"] == 1
    lidar2ego, cam2img = np.array(asked["calibration"]["lidar2ego"]), np.eye(4)
    cam2img[:3, :3] = asked["calibration"]["camera2image"]["CAM_FRONT"]
    ego2cam = np.linalg.inv(np.array(asked["calibration"]["camera2ego"]["CAM_FRONT"]))
    ahead = cam2img @ ego2cam @ lidar2ego @ [0.0, 10.0, 0.0, 1.0]  # 10 m ahead of the lidar: its y axis
    depth_m = 10.0 + 1.1 - 1.7
    np.testing.assert_allclose(
        ahead[:3] / ahead[2], [4 + 8 * -0.2 / depth_m, 3 + 8 * -1.9 / depth_m, 1], atol=1e-6
    )
    assert ahead[2] == pytest.approx(depth_m, abs=1e-6)
    yaw = YAW + 0.2
    signals = [402.0, -30.0, 2.0, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
    signals += [2.0, 0, 9.8, 0, 0, 0.2, 6.0, 0, 0]
    np.testing.assert_allclose(asked["canbus"], signals, atol=1e-5)
    assert asked["ego2world"][0][3] == 402.0


def test_turn_rates_are_small_where_the_heading_wraps() -> None:
    clip = observation()
    T = clip.T_world_ego.clone()
    for frame, yaw in enumerate((math.pi - 0.05, -math.pi + 0.05, -math.pi + 0.15)):
        T[frame, :2, :2] = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    assert float(canbus(dataclasses.replace(clip, T_world_ego=T), 1)[12]) == pytest.approx(0.2, abs=1e-5)


def test_the_lidar_frame_has_nuscenes_axes_also_without_a_sweep() -> None:
    clip = observation()
    unseen = dataclasses.replace(clip, sweep_valid=torch.zeros_like(clip.sweep_valid))
    assert T_ego_lidar(unseen, 0)[:3, 3].tolist() == pytest.approx([0.94, 0.0, 1.84], abs=1e-6)
    assert (T_ego_lidar(clip, 0)[:3, :3] @ torch.tensor([1.0, 0, 0], dtype=torch.float64)).tolist() == [
        0,
        -1,
        0,
    ]


def test_planners_that_are_to_see_lidar_are_sent_sweeps_and_nothing_else() -> None:
    message = planner_input(observation(), 2, 0, cameras=False, lidar=True)
    assert message.images == {}
    assert message.sweeps is not None
    points = torch.load(io.BytesIO(base64.b64decode(message.sweeps["LIDAR_TOP"])), weights_only=True)
    assert points["xyz"][0].tolist() == pytest.approx([6.1, 0.2, 1.9], abs=1e-6)
    assert (points["channel"].tolist(), len(points["xyz"])) == ([3], 1)


@pytest.mark.parametrize(
    ("plan", "told"),
    [
        (PLAN[:5], "answered 5 points; 6 or more are needed, for 3 s"),
        ([*PLAN[:5], [math.nan, 0.0]], "not pairs of finite numbers"),
        ([*PLAN[:5], [1.0, 2.0, 3.0]], "not pairs of finite numbers"),
        ("far away", "trajectory: Input should be a valid list"),
        ([PLAN[0]] * 5000, "answered 5000 points"),
        (None, "trajectory: Input should be a valid list"),
    ],
)
def test_an_answer_without_a_plan_is_one_line(plan: object, told: str) -> None:
    server = Recorder(plan)
    with server.served().in_background() as address, pytest.raises(InputError, match=told):
        HttpPlanner(address, lambda: 0.0).act(stack_records([observation()]))


def test_longer_plans_count_for_3_s() -> None:
    server = Recorder([*PLAN, [7.0, 2.0], [8.0, 3.0]])
    with server.served().in_background() as address:
        plan = HttpPlanner(address, lambda: 0.0).act(stack_records([observation()]))
    assert plan.xy.shape == (1, 1, 6, 2)


def test_a_planner_that_is_not_there_is_told_before_the_drives() -> None:
    with JsonServer({}).in_background() as served:
        address = dataclasses.replace(served, answer_s=0.2)
    with pytest.raises(InputError, match=rf"no planner is alive: http://127\.0\.0\.1:{address.port}/alive"):
        check_planner(address, within_s=0.2)


@dataclasses.dataclass
class Notes:
    """An agent that keeps its last observation and plans by it."""

    clock: Callable[[], float]
    seen: Clip | None = None
    at_s: float = 0.0

    def act(self, observation: Clip) -> Trajectory:
        self.seen, self.at_s = observation, self.clock()
        steps = torch.arange(1, 7)[:, None] * observation.ego_speed_mps[0, -1]
        return plan_of(
            torch.cat([steps, steps * float(observation.images[0, -1, 0, 1, 0, 0])], -1)[None, None]
        )


def test_an_agent_plans_the_same_over_the_wire() -> None:
    """Our client drives our server: the agent sees what it sees without them, but lidar and true boxes."""
    agents = list[Notes]()

    def make(clock: Callable[[], float]) -> Notes:
        agents.append(Notes(clock))
        return agents[-1]

    service = PlannerService(make, PlannerNeeds(past_frames=1, cameras=("pcam_b0", "pcam_f0")))
    now_s, clip = [0.0], observation(-1.0, 0.0)
    direct = Notes(lambda: 0.0)
    with JsonServer(service.answers()).in_background() as address:
        client = HttpPlanner(address, lambda: now_s[0])
        over_wire = client.act(stack_records([clip]))
    expected = direct.act(stack_records([clip.frames(slice(1, 3)).through([1, 0])]))
    assert torch.equal(over_wire.xy, expected.xy)
    seen, known = agents[-1].seen, direct.seen
    assert seen is not None
    assert known is not None
    assert torch.equal(seen.images, known.images)
    assert seen.rig.names == ("pcam_b0", "pcam_f0")
    for name in ("K", "T_ego_cam"):
        assert torch.allclose(getattr(seen.rig, name), getattr(known.rig, name))
    assert torch.equal(seen.T_world_ego, known.T_world_ego)
    assert torch.allclose(seen.t_s, known.t_s, atol=1e-6)
    assert int(seen.command) == int(Command.LEFT)
    assert not bool(seen.boxes_valid.any() | seen.sweep_valid.any())


def test_before_an_agent_has_seen_enough_the_answer_is_constant_velocity() -> None:
    service = PlannerService(Notes, PlannerNeeds(past_frames=3, cameras=()))
    asked = dataclasses.asdict(planner_input(observation(), 2, 1000, cameras=True, lidar=False))
    answer = service.answers()["POST", "/infer"](asked)
    assert isinstance(answer, dict)
    assert answer["trajectory"] == [[3.0 * k, 0.0] for k in range(1, 7)]


def message(**changes: object) -> dict[str, Any]:
    asked = dataclasses.asdict(planner_input(observation(), 2, 1000, cameras=True, lidar=False))
    return {**asked, **changes}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"command": 3}, "command must be one of"),
        ({"ego2world": [[1.0]]}, "ego2world has to be a 4 by 4 matrix"),
        ({"canbus": [0.0] * 5}, "canbus has 5 numbers"),
        ({"canbus": [float("nan")] * 16}, "the speed nan, which is not finite"),
        ({"images": {}}, "cameras not sent: pcam_f0; sent: none"),
        ({"images": {"CAM_FRONT": "@@"}}, "not a tensor in base64"),
        ({"timestamp": "soon"}, "timestamp: Input should be a valid integer"),
        ({"calibration": {"camera2image": {}, "camera2ego": {}, "lidar2ego": []}}, "no camera CAM_FRONT"),
    ],
)
def test_wrong_requests_to_our_planner_are_one_line(changes: dict[str, object], told: str) -> None:
    service = PlannerService(Notes, PlannerNeeds(past_frames=0, cameras=("pcam_f0",)))
    with pytest.raises(InputError, match=told):
        service.answers()["POST", "/infer"](message(**changes))


def test_time_has_to_go_on_until_a_reset() -> None:
    service = PlannerService(Notes, PlannerNeeds(past_frames=0, cameras=("pcam_f0",)))
    infer, reset = service.answers()["POST", "/infer"], service.answers()["POST", "/reset"]
    infer(message())
    with pytest.raises(InputError, match="timestamp 1000 is not after the one before"):
        infer(message())
    reset({})
    infer(message())


def saved(value: object, compressed: bool = False) -> str:
    buffer = io.BytesIO()
    torch.save(value, buffer)
    if compressed:
        packed = io.BytesIO()
        with zipfile.ZipFile(buffer) as there, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as smaller:
            for member in there.infolist():
                smaller.writestr(member.filename, there.read(member))
        buffer = packed
    return base64.b64encode(buffer.getvalue()).decode()


def reconstructed(rows: bytes, stride: bytes) -> bytes:
    """The pickle of an image of one column; rows and their stride are opcodes."""
    storage = b"(X\x07\0\0\0storagectorch\nByteStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x0ctQ"
    layout = b"(" + rows + b"K\x01K\x03t(" + stride + b"K\x03K\x01t"
    return b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\0" + layout + b"\x89NtR."


def archive_of(description: bytes) -> str:
    """What `torch.save` writes, with another description of its tensor of 12 bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", description)
        archive.writestr("archive/data/0", bytes(12))
    return base64.b64encode(buffer.getvalue()).decode()


class Code:
    def __reduce__(self) -> tuple[Any, ...]:
        return print, ("run",)


def test_images_run_no_code_and_are_bounded(capsys: pytest.CaptureFixture[str]) -> None:
    image = torch.arange(2 * 5 * 3, dtype=torch.uint8).reshape(2, 5, 3)
    assert torch.equal(decode_image(encode_tensors(image)), image)
    large = torch.zeros(400, 400, 3, dtype=torch.uint8)
    turned = torch.arange(60, dtype=torch.uint8).reshape(3, 4, 5)[:, 1:, ::2].permute(2, 1, 0)
    assert torch.equal(decode_image(encode_tensors(turned)), turned)
    described = archive_of(reconstructed(b"M\x10'", b"K\x03"))  # 10,000 rows of 3 bytes
    for text, told in (
        (archive_of(b"\x80\x02cbuiltins\nbytearray\nJ\xff\xff\xff\x7f\x85R."), "builtins.bytearray"),
        (archive_of(b"\x80\x02" + b"]" * 5000 + b"."), "too long"),
        (described, "may have 1 to 10,000 bytes, not 30,000"),
        (archive_of(reconstructed(b"M\xe8\x03", b"K\x03")), "has 12 bytes, and describes 3,000"),
        (archive_of(reconstructed(b"K\x04", b"J\xff\xff\xff\xff")), "may have 1 to"),
        (saved(Code()), "not a tensor in base64"),
        (saved(image.float()), "has to be uint8"),
        (saved([image]), "got list"),
        (saved(image[None]), "has to be uint8"),
        (saved(large, compressed=True), "may have 10,000 bytes, not 4"),
        (saved(torch.zeros(1, 1, 3, dtype=torch.uint8).expand(9000, 9000, 3)), "may have 1 to 10,000 bytes"),
        (saved(torch.zeros(0, 4, 3, dtype=torch.uint8)), "may have 1 to"),
    ):
        with pytest.raises(InputError, match=told):
            decode_image(text, max_bytes=10_000)
    assert "run" not in capsys.readouterr().out


def test_the_address_of_a_message_field_is_told() -> None:
    with pytest.raises(InputError, match="/infer: canbus"):
        PlannerService(Notes, PlannerNeeds(0, ())).answers()["POST", "/infer"](message(canbus="none"))
    assert PlannerInput.__dataclass_fields__.keys() >= message().keys()
    assert Address("a", 1).answer_s > 0
