"""Many drives at once: the same bytes as one after another, none twice, none lost for another's failure."""

import functools
import os
import signal
from pathlib import Path

import pytest
from file_digests import digests

from foredrive.cli.arguments import chosen_rig
from foredrive.data.cameras import rig_of_log
from foredrive.data.logs import Log
from foredrive.engine.fan_out import fan_out
from foredrive.errors import InputError
from foredrive.runs.drive.recording import RecordingResult, is_recorded, record_drives, record_plan
from foredrive.sensors.rigs import DRIVING, SURROUND, TELE, Mount, RigPlan, rig_yaml, same_rig
from foredrive.towns.campaign import DrivePlan

RIG = SURROUND.of_size((36, 64))
PLANS = [
    DrivePlan("Town02", seed, conditions, 6, 4, 1.0, 2.0)
    for seed, conditions in ((1, None), (2, None), (2, "clear"))
]
LOST = DrivePlan("Town99", 1, None, 6, 4, 1.0, 2.0)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("campaign")


@pytest.fixture(scope="module")
def recorded(root: Path) -> RecordingResult:
    return record_drives([LOST, *PLANS], root, RIG, workers=2)


@pytest.mark.slow
def test_side_by_side_gives_the_bytes_of_one_after_another(
    recorded: RecordingResult, root: Path, tmp_path: Path
) -> None:
    assert list(recorded.logs) == PLANS
    for plan in PLANS[1:]:
        record_plan(plan, tmp_path, RIG)
    one_by_one = digests(tmp_path)
    assert {f"logs/town_train/{plan.log_name}/sync.arrow" for plan in PLANS[1:]} <= set(one_by_one)
    assert one_by_one.items() <= digests(root).items()


def test_a_drive_that_fails_is_named_and_the_others_go_on(recorded: RecordingResult) -> None:
    assert list(recorded.failed) == [LOST]
    assert "unknown town 'Town99'" in recorded.failed[LOST]


def test_whole_logs_are_skipped(recorded: RecordingResult, root: Path) -> None:
    before, ticks = {file: file.stat().st_mtime_ns for file in root.rglob("*.arrow")}, []
    again = record_drives(PLANS, root, RIG, workers=2, tick=lambda: ticks.append(None))
    assert (again.skipped, again.logs, again.failed) == (len(PLANS), recorded.logs, {})
    assert len(ticks) == len(PLANS)
    assert {file: file.stat().st_mtime_ns for file in root.rglob("*.arrow")} == before


def test_a_log_of_another_length_rate_or_size_does_not_count(recorded: RecordingResult, root: Path) -> None:
    plan = PLANS[0]
    assert is_recorded(plan, root, RIG)
    assert not is_recorded(plan, root, SURROUND.of_size((72, 128)))
    for other in ({"seconds": 2.0}, {"rate_hz": 1.0, "seconds": 2.0}, {"seed": 7}):
        assert not is_recorded(DrivePlan(**(vars(plan) | other)), root, RIG)


def test_cameras_keep_their_names(tmp_path: Path) -> None:
    """Two look ahead and one behind, under names that do not follow from the directions."""
    ahead, behind = Mount((1.7, 0.0, 1.6), 0.0, 70.0), Mount((0.0, 0.0, 1.6), 180.0, 90.0)
    rig = RigPlan((36, 64), {"PCAM_L2": ahead, TELE: DRIVING.cameras[TELE], "PCAM_R0": behind})
    plan = DrivePlan("Town02", 1, None, 0, 0, 0.5, 2.0)
    assert same_rig(rig_of_log(Log(record_plan(plan, tmp_path, rig))), rig)
    assert is_recorded(plan, tmp_path, rig)


@pytest.mark.parametrize(
    ("rig", "message"),
    [
        (RigPlan((36, 64), {"FRONT": Mount((0.0, 0.0, 0.0), 0.0, 90.0)}), "123D has no camera 'FRONT'"),
        (SURROUND.of_size((36, 20_000)), "image_hw must be 1 to 16384 px"),
    ],
)
def test_a_rig_that_cannot_be_recorded_is_told_at_once(rig: RigPlan, message: str, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(rig_yaml(rig))
    with pytest.raises(InputError, match=message):
        chosen_rig(str(tmp_path / "rig.yaml"), None)


def test_a_refusing_disk_ends_it_all(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("in the way")
    with pytest.raises(OSError, match="logs"):
        record_drives(PLANS[:1], tmp_path, RIG, workers=1)


def die_of_the_first(plan: DrivePlan) -> None:
    if plan.seed == 1:
        os._exit(1)


@pytest.mark.parametrize("workers", [1, 3])
def test_a_process_that_dies_takes_its_own_drive_along(workers: int) -> None:
    results = dict(fan_out(PLANS, die_of_the_first, workers))
    assert {plan: isinstance(result, BaseException) for plan, result in results.items()} == {
        PLANS[0]: True,
        PLANS[1]: False,
        PLANS[2]: False,
    }


def die_once(number: int, folder: Path) -> int:
    if number == 2 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def test_nothing_is_lost_with_a_killed_process(tmp_path: Path) -> None:
    results = fan_out(range(5), functools.partial(die_once, folder=tmp_path), 2)
    assert dict(results) == {0: 0, 1: 1, 2: 4, 3: 9, 4: 16}
    assert (tmp_path / "died").exists()
