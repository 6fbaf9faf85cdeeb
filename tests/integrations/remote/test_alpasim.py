"""AlpaSim's driver contract over real gRPC: both of our sides, and a fake loop that is not ours."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch

pytest.importorskip("carla_driver_interface")

from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult
from carla_driver_interface.geometry import Pose
from carla_driver_interface.geometry import Trajectory as TimedPoses
from carla_driver_interface.server import serving
from carla_driver_interface.testing import FakeCamera, FakeLoop
from test_planner_protocol import observation

from foredrive.data.batches import stack_records
from foredrive.driving.simple_agents import StraightAgent, plan_of
from foredrive.errors import InputError
from foredrive.integrations.remote.alpasim_client import GrpcDriver, check_driver, points_of
from foredrive.integrations.remote.alpasim_server import AlpasimDriver, route_of, serve_alpasim
from foredrive.integrations.remote.planner_server import PlannerNeeds
from foredrive.json_http import Address
from foredrive.scene import Clip, Command, Trajectory
from foredrive.scene.clip import TARGET


@dataclasses.dataclass
class Looks:
    """An agent that plans by what it sees: speed, images, command and motion."""

    clock: Callable[[], float]
    seen: Clip | None = None

    def act(self, observation: Clip) -> Trajectory:
        self.seen = observation
        now = observation.now
        x = torch.arange(1, 7) * 0.5 * observation.ego_speed_mps[0, now]
        bend = 0.01 * float(observation.images[0, now, 0].float().mean()) + 0.1 * float(
            observation.command[0]
        )
        return plan_of(torch.stack([x, bend * torch.arange(1, 7)], -1)[None, None])


@contextmanager
def served(driver: AlpasimDriver) -> Iterator[Address]:
    server, port = serve_alpasim(driver, "127.0.0.1", 0)
    server.start()
    try:
        yield Address("127.0.0.1", port, 20.0)
    finally:
        server.stop(grace=0.5).wait()


def driver(made: list[Looks], past_frames: int = 1, cameras: tuple[str, ...] | None = None) -> AlpasimDriver:
    def make(clock: Callable[[], float]) -> Looks:
        made.append(Looks(clock))
        return made[-1]

    return AlpasimDriver("looks", make, PlannerNeeds(past_frames, cameras))


def test_plans_are_the_same_over_the_wire() -> None:
    clip, made, now_s = observation(-1.0, 0.0), list[Looks](), [0.0]
    direct = Looks(lambda: 0.0)
    expected = direct.act(stack_records([clip.frames(slice(1, 3))]))
    with served(driver(made)) as address:
        check_driver(address, 10.0)
        planner = GrpcDriver(address, lambda: now_s[0])
        over_wire = planner.act(stack_records([clip]))
        seen = made[0].seen
        now_s[0] = 0.5
        again = planner.act(stack_records([clip]))
        del planner
    torch.testing.assert_close(over_wire.xy, expected.xy, atol=1e-3, rtol=0)
    torch.testing.assert_close(again.xy, expected.xy, atol=1e-3, rtol=0)
    known = direct.seen
    assert seen is not None
    assert known is not None
    assert torch.equal(seen.images, known.images)
    torch.testing.assert_close(seen.rig.K, known.rig.K)
    torch.testing.assert_close(seen.rig.T_ego_cam, known.rig.T_ego_cam, atol=1e-5, rtol=0)
    motion, truth = (
        torch.linalg.inv(each.T_world_ego[0, 0]) @ each.T_world_ego[0, 1] for each in (seen, known)
    )
    torch.testing.assert_close(motion, truth, atol=1e-4, rtol=0)
    assert int(seen.command[0]) == int(Command.LEFT)


def test_another_simulator_drives_our_agent() -> None:
    """The fake loop of the contract's package follows each plan exactly, at 10 Hz on a straight road."""
    straight = AlpasimDriver("straight", lambda clock: StraightAgent(6.0), PlannerNeeds(1, ("camera_front",)))
    with served(straight) as address, FakeLoop(str(address), [FakeCamera(width=64, height=36)]) as loop:
        result = loop.run(12)
    speeds = np.array(result.speeds_mps)
    assert result.steps == 12
    np.testing.assert_allclose(speeds[7:], 6.0, atol=0.01)  # after 0.5 s there are two key frames
    np.testing.assert_allclose(speeds[:5], 0.0, atol=0.01)
    np.testing.assert_allclose(result.lateral_offsets_m, 0.0, atol=1e-3)


def test_a_vehicle_without_the_agents_cameras_is_refused() -> None:
    with served(driver([], cameras=("pcam_l0",))) as address:
        planner = GrpcDriver(address, lambda: 0.0)
        with pytest.raises(
            InputError, match=r"FAILED_PRECONDITION: .*cameras not declared: pcam_l0; declared: PCAM"
        ):
            planner.act(stack_records([observation()]))


class Answers(BaseDriver):
    """A driver that answers some poses in the rig frame."""

    def __init__(self, poses: list[tuple[float, float, float]], wait_s: float = 0.0) -> None:
        self.poses, self.wait_s = poses, wait_s

    def drive(self, ctx: DriveContext) -> DriveResult:
        time.sleep(self.wait_s)
        plan = TimedPoses.empty()
        for after_s, x, y in self.poses:
            plan.append(ctx.time_now_us + round(after_s * 1e6), Pose.from_xyz_yaw(x, y, 0.0, 0.0))
        return DriveResult(plan)


@pytest.mark.parametrize(
    ("poses", "wait_s", "told"),
    [
        ([], 0.0, "poses, which do not cover 3 s"),
        ([(0.0, 0.0, 0.0), (2.5, 9.0, 0.0)], 0.0, "poses, which do not cover 3 s"),
        ([(0.0, 0.0, 0.0), (4.0, float("nan"), 0.0)], 0.0, "not finite|UNKNOWN"),
        ([(0.0, 0.0, 0.0), (4.0, 8.0, 0.0)], 2.0, "no answer within 1 s"),
    ],
)
def test_a_driver_without_a_plan_is_one_line(
    poses: list[tuple[float, float, float]], wait_s: float, told: str
) -> None:
    with serving(Answers(poses, wait_s), 0, "127.0.0.1") as port:
        planner = GrpcDriver(Address("127.0.0.1", port, 1.0), lambda: 0.0)
        with pytest.raises(InputError, match=told) as caught:
            planner.act(stack_records([observation()]))
    assert "\n" not in str(caught.value)


def test_plans_in_between_key_frames_are_interpolated() -> None:
    with serving(Answers([(0.0, 0.0, 0.0), (4.0, 8.0, 4.0)]), 0, "127.0.0.1") as port:
        plan = GrpcDriver(Address("127.0.0.1", port, 10.0), lambda: 0.0).act(stack_records([observation()]))
    expected = torch.tensor([[0.5 * k * 2.0, 0.5 * k * 1.0] for k in range(1, 7)])
    torch.testing.assert_close(plan.xy[0, 0], expected, atol=1e-3, rtol=0)


def test_a_plan_that_begins_late_is_refused() -> None:
    """Its first pose, at 2 s, is not that at 0.5 s."""
    late = TimedPoses([2_000_000, 4_000_000], [Pose.from_xyz_yaw(x, 0.0, 0.0, 0.0) for x in (16.0, 32.0)])
    with pytest.raises(InputError, match="2 poses, which do not cover 3 s"):
        points_of(late, np.eye(4), 0)


def test_nobody_listens() -> None:
    with pytest.raises(InputError, match="no driver is alive: grpc://127"):
        check_driver(Address("127.0.0.1", 9, 1.0), 0.3)


def test_routes_give_command_and_target() -> None:
    left = np.array([[-5.0, 0, 0], [0, 0, 0], [10, 0, 0], [20, 8, 0], [30, 20, 0]], dtype=float)
    command, route = route_of(left)
    assert command is Command.LEFT
    assert route is not None
    np.testing.assert_allclose(route.xy[:3], [[2.0, 0.0], [5.0, 0.0], [10.0, 0.0]])
    assert float(np.hypot(*(route.xy[TARGET] - [10.0, 0.0]))) == pytest.approx(10.0)
    assert route.valid.tolist() == [True] * 6 + [False]  # it is 38.4 m long
    assert route_of(np.zeros((0, 3))) == (Command.STRAIGHT, None)
