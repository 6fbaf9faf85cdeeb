"""The rigs of a run's training logs, and the rigs that it may drive with."""

import dataclasses
from pathlib import Path

import pytest
from test_recording import PLANS, RIG

from foredrive.errors import InputError
from foredrive.runs.drive.recording import record_plan
from foredrive.runs.train.rigs import (
    TrainedRigs,
    check_rig,
    read_rigs,
    trained_rigs,
    write_rigs,
)
from foredrive.sensors.rigs import DRIVING, RigPlan, same_rig


def changed(rig: RigPlan, name: str = "PCAM_B0", **changes: object) -> RigPlan:
    """The rig with one camera changed."""
    mount = dataclasses.replace(rig.cameras[name], **changes)
    return RigPlan(rig.image_hw, {**rig.cameras, name: mount})


TURNED = changed(RIG, yaw_deg=-176.0)
RAISED = changed(RIG, xyz_m=(0.03, 0.0, 1.9))


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> TrainedRigs:
    """Rigs of three logs: two usual ones, and one whose rear camera is turned and raised."""
    folder = tmp_path_factory.mktemp("rigs")
    other = changed(TURNED, xyz_m=(0.03, 0.0, 1.9))
    logs = [
        record_plan(plan, folder / str(number), rig)
        for number, (plan, rig) in enumerate(zip(PLANS[:1] * 3, (other, RIG, RIG), strict=True))
    ]
    found = trained_rigs(logs, tuple(RIG.cameras))
    assert found is not None
    return found


def test_the_usual_rig_and_its_range_come_from_the_logs(rigs: TrainedRigs, tmp_path: Path) -> None:
    assert same_rig(rigs.usual, RIG)
    low, high = (one.cameras["PCAM_B0"] for one in (rigs.lowest, rigs.highest))
    assert high.yaw_deg - low.yaw_deg == pytest.approx(4.0, abs=1e-3)  # across 180°
    assert (low.xyz_m[2], high.xyz_m[2]) == pytest.approx((1.6, 1.9), abs=1e-5)
    assert low.fov_deg == pytest.approx(high.fov_deg) == pytest.approx(110.0, abs=1e-3)
    write_rigs(rigs, tmp_path)
    assert read_rigs(tmp_path) == rigs
    assert read_rigs(tmp_path / "elsewhere") is None


@pytest.mark.parametrize(
    "rig",
    [
        RIG,
        TURNED,
        changed(RIG, yaw_deg=-175.0),  # 1° beyond the range
        changed(RIG, yaw_deg=182.0),
        changed(RIG, xyz_m=(0.03, 0.0, 1.98)),
        RIG.of_size((72, 128)),
    ],
)
def test_a_rig_within_the_range_is_known(rig: RigPlan, rigs: TrainedRigs) -> None:
    check_rig(rigs, rig, "runs/town")


@pytest.mark.parametrize(
    ("rig", "message"),
    [
        (DRIVING, "was trained with the cameras PCAM_F0, .*, not .*FTCAM_TELE_F0"),
        (changed(RIG, yaw_deg=-173.0), "camera PCAM_B0: yaw .degrees. is 3 outside"),
        (changed(RIG, yaw_deg=170.0), "camera PCAM_B0: yaw .degrees. is 10 outside"),
        (changed(RIG, xyz_m=(0.03, 0.0, 1.4)), "camera PCAM_B0: z .m. is 0.2 outside"),
        (changed(RIG, name="PCAM_F0", fov_deg=60.0), "camera PCAM_F0: fov .degrees. is 10 outside"),
        (changed(RIG, name="PCAM_F0", pitch_deg=5.0), "camera PCAM_F0: pitch .degrees. is 5 outside"),
    ],
)
def test_another_rig_is_refused_by_name(rig: RigPlan, message: str, rigs: TrainedRigs) -> None:
    with pytest.raises(InputError, match=f"runs/town: .*{message}"):
        check_rig(rigs, rig, "runs/town")


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "rigs.yaml").write_text("usual: 3\n")
    with pytest.raises(InputError, match=r"rigs\.yaml: not camera rigs"):
        read_rigs(tmp_path)


@pytest.mark.slow
def test_cameras_that_a_log_lacks_are_left_out(tmp_path: Path) -> None:
    few = RigPlan(RIG.image_hw, {name: RIG.cameras[name] for name in ("PCAM_F0", "PCAM_L0")})
    one = RigPlan(RIG.image_hw, {"PCAM_F0": RIG.cameras["PCAM_F0"]})
    logs = [record_plan(PLANS[0], tmp_path / str(i), rig) for i, rig in enumerate((few, one))]
    found = trained_rigs(logs, ("PCAM_F0", "PCAM_L0"))
    assert found is not None
    assert list(found.usual.cameras) == ["PCAM_F0"]
    assert trained_rigs(logs, ("PCAM_R0",)) is None
