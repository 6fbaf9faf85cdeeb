"""Fixtures that several folders of tests share; Triton's interpreter; Ctrl-C in the background.

What takes seconds to import is imported by the fixtures that need it, so that tests of one folder start soon.
"""

import functools
import math
import os
import signal
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import settings
from jaxtyping import Float64

import shape_checks  # isort: skip

shape_checks.install()  # before anything of the package is imported

from foredrive.geometry.se3 import (  # noqa: E402
    exp_se3,
    inverse_se3,
    matrix_from_yaw,
    rotate_vectors,
    transform_points,
    yaw_from_matrix,
)
from foredrive.scene import (  # noqa: E402
    Boxes,
    CameraRig,
    Clip,
    Command,
    Example,
    LidarSweep,
    Trajectory,
    VoxelGrid,
    VoxelSpec,
)
from foredrive.scene.boxes import unlabelled  # noqa: E402
from foredrive.scene.clip import ROUTE_M  # noqa: E402

if TYPE_CHECKING:
    from foredrive.data import LogPath
    from foredrive.runs import Run
    from foredrive.runs.reconstruction.reconstruct import Reconstruction
    from foredrive.towns.map.town_map import TownMap
    from foredrive.towns.world import World

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # for tests/ops; Triton reads it when something imports it first

# A shell that runs `make test &` has SIGINT ignored. All processes below inherit that, also those that tests
# start and interrupt. With a handler here they start with the default.
_IN_MAIN_THREAD = threading.current_thread() is threading.main_thread()
if _IN_MAIN_THREAD and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("untimed", deadline=None)  # how long an example takes is the machine's affair
settings.load_profile("untimed")

_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real logs; the test is skipped where there is none."""
    folder = Path(os.environ.get("FOREDRIVE_REAL_DATA", _BESIDE))
    if not folder.is_dir():
        pytest.skip("no real logs here: set FOREDRIVE_REAL_DATA")
    return folder


LONGEST = "tests/end_to_end/test_pages_run.py"
"""File of tests that takes longest."""


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Shuffle the files where several workers share them, the same way in each worker.

    Files of one folder use the same kernels. Side by side, two workers would compile each of them twice.
    The longest file comes first, so that no worker waits for it at the end.
    """
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: (item.location[0] != LONGEST, zlib.crc32(item.location[0].encode())))


def pytest_runtest_setup() -> None:
    shape_checks.begin_test()


def driven_arc(
    speed_mps: torch.Tensor, turn_radps: torch.Tensor, t_s: torch.Tensor
) -> Float64[torch.Tensor, "b T 4 4"]:
    """T_now_ego of vehicles that drive arcs, [b] speeds and yaw rates at [b, T] times."""
    twist = torch.zeros(*t_s.shape, 6, dtype=torch.float64)
    twist[..., 0], twist[..., 5] = speed_mps[:, None] * t_s, turn_radps[:, None] * t_s
    return exp_se3(twist)


def synthetic_example(
    *, batch: int = 2, past: int = 1, future: int = 2, cameras: int = 2, spec: VoxelSpec, seed: int = 0
) -> Example:
    """A batch of well-formed but arbitrary examples: what networks and loops are tried on.

    Item i drives an arc at 4 + i m/s and 0.2 - 0.3 i rad/s at a place of its own. Poses, speed, command,
    target point and future agree with that, and boxes drive straight on over ground.
    """
    rng = torch.Generator().manual_seed(seed)
    frames, height, width, boxes, steps = past + 1 + future, 32, 64, 3, 6
    shape = (batch, frames)
    item = torch.arange(batch)
    speed_mps, turn_radps = 4.0 + item, 0.2 - 0.3 * item
    t_s = ((torch.arange(frames) - past) * 0.5).expand(shape)
    T_now_ego = driven_arc(speed_mps, turn_radps, t_s)
    T_world_now = matrix_from_yaw(
        0.7 + 1.3 * item.double(),
        torch.stack([300.0 + 40 * item, -120.0 - 25 * item, 12.0 + item], -1).double(),
    )
    T_now_step = driven_arc(speed_mps, turn_radps, 0.5 * torch.arange(1, steps + 1).expand(batch, steps))
    K = torch.tensor([[40.0, 0.0, 32.0], [0.0, 40.0, 16.0], [0.0, 0.0, 1.0]]).expand(*shape, cameras, 3, 3)
    yaw = torch.arange(cameras) * (2 * math.pi / cameras)
    looking_forward = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_ego_cam = matrix_from_yaw(yaw, torch.tensor([0.0, 0.0, 1.6]).expand(cameras, 3))
    T_ego_cam[:, :3, :3] = T_ego_cam[:, :3, :3] @ looking_forward
    rig = CameraRig(
        K=K,
        T_ego_cam=T_ego_cam.expand(*shape, cameras, 4, 4),
        dist=torch.zeros(*shape, cameras, 5),
        readout_s=torch.zeros(*shape, cameras),
        names=tuple(f"camera_{i}" for i in range(cameras)),
        size_hw=(height, width),
    )
    no_beams = torch.zeros(*shape, 0)
    sweeps = LidarSweep(
        origin_ego=torch.zeros(*shape, 0, 3),
        dir_ego=torch.zeros(*shape, 0, 3),
        range_m=no_beams,
        returned=no_beams.bool(),
        intensity=no_beams,
        dt_s=no_beams,
        beam=no_beams.long(),
        valid=no_beams.bool(),
    )
    yes = torch.ones(*shape, dtype=torch.bool)
    T_ego_now = inverse_se3(T_now_ego).float()
    over_ground = torch.tensor([5.0, 5.0, 0.0])
    centre_now, velocity_now = torch.randn(2, batch, 1, boxes, 3, generator=rng) * over_ground
    centre_now = centre_now + velocity_now * t_s[:, :, None, None]
    velocity_ego = rotate_vectors(T_ego_now, velocity_now.expand_as(centre_now))
    clip = Clip(
        t_s=t_s,
        T_world_ego=T_world_now[:, None] @ T_now_ego,
        images=torch.randint(0, 256, (*shape, cameras, 3, height, width), generator=rng, dtype=torch.uint8),
        image_valid=torch.ones(*shape, cameras, dtype=torch.bool),
        rig=rig,
        sweeps=sweeps,
        sweep_valid=~yes,
        misses_known=~yes,
        boxes=Boxes(
            centre=transform_points(T_ego_now, centre_now),
            size_lwh=torch.tensor([4.0, 2.0, 1.5]).expand(*shape, boxes, 3),
            yaw=torch.atan2(velocity_ego[..., 1], velocity_ego[..., 0]),
            velocity=velocity_ego[..., :2],
            track_id=torch.arange(boxes).expand(*shape, boxes),
            category=torch.zeros(*shape, boxes, dtype=torch.long),
            valid=torch.ones(*shape, boxes, dtype=torch.bool),
            **unlabelled(*shape, boxes),
        ),
        boxes_valid=yes,
        ego_speed_mps=speed_mps[:, None].expand(shape),
        ego_speed_valid=yes,
        command=torch.where(turn_radps > 0, Command.LEFT, Command.RIGHT),
        command_valid=torch.ones(batch, dtype=torch.bool),
        route_xy=torch.tensor(ROUTE_M)[:, None]
        * torch.stack([1.0 + 0.05 * item, 0.3 - 0.45 * item], -1)[:, None],
        route_valid=torch.ones(batch, len(ROUTE_M), dtype=torch.bool),
        future=Trajectory(
            xy=T_now_step[:, None, :, :2, 3].float(),
            yaw=yaw_from_matrix(T_now_step)[:, None].float(),
            valid=torch.ones(batch, 1, steps, dtype=torch.bool),
            log_prob=torch.zeros(batch, 1),
            dt_s=0.5,
        ),
    )
    occupied = (torch.rand(*shape, 1, *spec.shape_zyx, generator=rng) > 0.9).float()
    known = torch.rand(*shape, *spec.shape_zyx, generator=rng) > 0.5
    flow_mps = torch.randn(*shape, 3, *spec.shape_zyx, generator=rng)
    return Example(
        clip=clip,
        occupancy=VoxelGrid(spec, occupied, known),
        flow=VoxelGrid(spec, flow_mps * known[:, :, None], known),
        key=tuple(f"log_{i}@0.0s" for i in range(batch)),
    )


@pytest.fixture(scope="session")
def make_example() -> Callable[..., Example]:
    """See `synthetic_example`."""
    return synthetic_example


@pytest.fixture
def navsim() -> Iterator[None]:
    """Modules with the records of NAVSIM's interface; other tests expect theirs to be absent."""
    from foredrive.integrations.navsim.stand_ins import add_stand_ins

    before = set(sys.modules)
    add_stand_ins()
    yield
    for name in set(sys.modules) - before:
        if name.partition(".")[0] in {"navsim", "nuplan", "pytorch_lightning"}:
            del sys.modules[name]


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory) -> "LogPath":
    from miniature import write_log

    return write_log(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="session")
def trained(log: "LogPath", tmp_path_factory: pytest.TempPathFactory) -> "Run":
    """A run that was never interrupted."""
    from miniature import miniature

    from foredrive.runs import train_run

    return train_run(miniature(), [log], tmp_path_factory.mktemp("runs") / "trained")


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> "Reconstruction":
    """Five frames of one camera, reconstructed. Tests do not change its folder."""
    from builders import ONE_CAMERA, reconstructed_log

    return reconstructed_log(tmp_path_factory.mktemp("reconstructed"), frames=5, recipe=ONE_CAMERA)


@pytest.fixture(scope="session")
def town_of() -> "Callable[[str], TownMap]":
    """The map of a town by its name; all of them together take some tens of MB."""
    from foredrive.towns.map.loading import load_town_map

    return functools.cache(load_town_map)


@pytest.fixture(scope="session")
def town02(town_of: "Callable[[str], TownMap]") -> "TownMap":
    return town_of("Town02")


@pytest.fixture(scope="session")
def world02(town02: "TownMap") -> "World":
    from foredrive.scene.conditions import Conditions
    from foredrive.towns.world import World

    return World(town02, seed=3, conditions=Conditions(hour=12.0))
