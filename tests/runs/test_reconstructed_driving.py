"""Drives in a small log that was reconstructed, with cameras and lidar: kept, recorded, and looked at."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import synthetic_log as world
import torch
from builders import SMALLEST

from foredrive.cli.main import main
from foredrive.data import ClipConfig, ClipDataset, LogPath, find_logs
from foredrive.data.drives import read_drive as read_log
from foredrive.driving.replay.threats import Threat
from foredrive.engine.config import save_recipe
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.methods.reconstruction.renderer import ReconstructedRenderer
from foredrive.runs import Run, evaluate_run
from foredrive.runs.drive.agent_inputs import chosen_cameras
from foredrive.runs.drive.in_reconstruction import REPLAY, ReconstructedRoutes, shown_vehicle
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction
from foredrive.scene import Renderer, VoxelSpec
from foredrive.sensors.rigs import FRONT_TELE, SURROUND, TELE, RigPlan, camera_rig
from foredrive.view.drive_report import write_drive_report

VOXELS = VoxelSpec(lower_m=(-8.0, -8.0, -1.0), voxel_m=2.0, shape_zyx=(2, 8, 8))


@pytest.fixture(scope="module")
def out(reconstructed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drives")
    drive_suite(DriveSuite(REPLAY, ReconstructedRoutes(str(reconstructed))), folder)
    return folder


def test_a_renderer_shows_what_was_recorded(reconstructed: Path) -> None:
    """As near as two steps of learning bring it: the boxes' colours, and the ground under the lidar."""
    opened = open_reconstruction(reconstructed)
    renderer = ReconstructedRenderer(opened.scene, opened.scene.graph, opened.vehicle)
    assert isinstance(renderer, Renderer)
    assert renderer.rig.names == ("ahead", "left")
    log = read_log(find_logs(reconstructed.parent)[0], SMALLEST.image_hw)
    twist = torch.tensor([world.EGO_SPEED_MPS, 0.0, 0.0, 0.0, 0.0, 0.0])
    seen = renderer.render(log.T_world_ego[5], twist, float(log.t_s[5]))
    off = (seen.images.float() - log.images[5].float()).abs().mean()
    shuffled = (seen.images.flip(0).float() - log.images[5].float()).abs().mean()
    assert float(off) < 0.9 * float(shuffled)
    assert seen.sweep is not None
    down = seen.sweep.returned & (seen.sweep.beam == 0)
    expected_m = world.LIDAR_EGO_M[2] / -float(seen.sweep.dir_ego[down][0, 2])
    assert float(seen.sweep.range_m[down].median()) == pytest.approx(expected_m, rel=0.3)


def test_a_drive_is_kept_and_is_a_log_like_any_other(out: Path) -> None:
    summary = read_summary(out / "summary.json")
    assert (summary["drives"], summary["failed"], summary["endings.completed"]) == (1, 0, 1)
    (log,) = find_logs(out)
    assert log.name == "reconstructed_test/from0.5s"
    dataset = ClipDataset([log], ClipConfig(1, 1, (24, 48), VOXELS, lidar=True), None)
    example = dataset[0]
    assert example.clip.command_valid.all()
    assert dataset.command_source["route"] == len(dataset)
    assert example.clip.images.float().std() > 5
    assert bool(example.clip.misses_known.all())
    assert example.clip.sweeps.returned.float().mean() > 0.1
    ids = example.clip.boxes.track_id[example.clip.boxes.valid]
    assert set(ids.tolist()) == {7, 11}
    assert example.occupancy.known.any()
    assert float(example.clip.ego_speed_mps[1]) == pytest.approx(world.EGO_SPEED_MPS, abs=0.5)


def test_a_trained_run_drives_and_is_judged_on_what_was_driven(
    trained: Run, reconstructed: Path, out: Path, tmp_path: Path
) -> None:
    suite = DriveSuite(str(trained.folder), ReconstructedRoutes(str(reconstructed)))
    (drive,) = drive_suite(suite, tmp_path / "drives").drives.values()
    assert drive.error == ""
    assert drive.score.duration_s > 1
    result = evaluate_run(trained, find_logs(out), tmp_path / "judged", views=False)
    assert result.failures == ()
    assert result.summary["command_source"] == "route"


def test_an_agent_that_requires_other_cameras_is_shown_its_own(
    reconstructed: Path, trained: Run, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The driver of the package has two cameras with 100 and 45 degrees; the log has others."""
    assert shown_vehicle(str(reconstructed), str(trained.folder)).rig.names == ("ahead", "left")
    assert not caplog.messages
    shown = shown_vehicle(str(reconstructed), "embedded")
    assert shown.learned == (0, 0)  # both look ahead
    rig = shown.rig
    assert [name.upper() for name in rig.names] == list(FRONT_TELE.cameras)
    assert rig.size_hw == FRONT_TELE.image_hw
    expected = camera_rig(None, 0.0, FRONT_TELE)
    torch.testing.assert_close(rig.K, expected.K)
    torch.testing.assert_close(rig.T_ego_cam, expected.T_ego_cam, atol=1e-6, rtol=0)
    assert "the agent's own are rendered" in caplog.messages[0]
    suite = DriveSuite("embedded", ReconstructedRoutes(str(reconstructed)))
    (drive,) = drive_suite(suite, tmp_path).drives.values()
    assert drive.error == ""
    assert drive.score.duration_s > 1


def test_an_agent_may_require_cameras_by_the_other_of_their_names(
    reconstructed: Path, trained: Run, tmp_path: Path
) -> None:
    """The log calls its cameras "ahead" and "left", and the recipe asks for PCAM_L0."""
    shutil.copytree(trained.folder, tmp_path / "run")
    clips = dataclasses.replace(trained.recipe.clips, cameras=("PCAM_L0",))
    save_recipe(dataclasses.replace(trained.recipe, clips=clips), tmp_path / "run" / "config.yaml")
    vehicle = shown_vehicle(str(reconstructed), str(tmp_path / "run"))
    assert vehicle.rig.names == ("ahead", "left")
    assert chosen_cameras(str(tmp_path / "run"), vehicle) == [1]
    assert chosen_cameras(str(trained.folder), vehicle) == [0, 1]
    suite = DriveSuite(str(tmp_path / "run"), ReconstructedRoutes(str(reconstructed)))
    (drive,) = drive_suite(suite, tmp_path / "drives").drives.values()
    assert drive.error == ""
    clips = dataclasses.replace(clips, cameras=("PCAM_B0",))
    save_recipe(dataclasses.replace(trained.recipe, clips=clips), tmp_path / "run" / "config.yaml")
    with pytest.raises(
        InputError, match=r"no reconstructed camera 'PCAM_B0'; there are: ahead \(pcam_f0\), "
    ):
        chosen_cameras(str(tmp_path / "run"), vehicle)


def test_other_cameras_take_what_was_learned_of_the_most_similar_ones(reconstructed: Path) -> None:
    """The tilted narrow camera is like the narrow one, not like the wide one, which looks ahead too."""
    plan = RigPlan(SURROUND.image_hw, {**SURROUND.cameras, TELE: FRONT_TELE.cameras[TELE]})
    vehicle = open_reconstruction(reconstructed).vehicle
    logged = dataclasses.replace(vehicle, rig=camera_rig(None, 0.0, plan))
    seen = logged.with_rig(camera_rig(None, 0.0, FRONT_TELE))
    assert seen.learned == (0, 6)
    # Once more, by way of the cameras in between
    assert seen.with_rig(camera_rig(None, 0.0, FRONT_TELE.of_size((48, 128)))).learned == (0, 6)


def test_what_lies_there_is_not_driven_again(reconstructed: Path, out: Path) -> None:
    suite = DriveSuite(REPLAY, ReconstructedRoutes(str(reconstructed)))
    file = out / "drives" / "from0.5s.json"
    before = file.stat().st_mtime_ns
    drive_suite(suite, out)
    assert file.stat().st_mtime_ns == before
    with pytest.raises(InputError, match="another suite"):
        drive_suite(dataclasses.replace(suite, agent="stop"), out)


def test_a_report_has_the_drive_and_its_film(out: Path) -> None:
    page = write_drive_report(out).read_text()
    assert 'id="from0.5s"' in page
    assert (out / "videos" / "from0.5s.webp").stat().st_size > 1000


def test_the_verb_drives_against_a_threat(
    reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From 3 s on the log is too short to meet anybody."""
    command = [
        "drive",
        "--agent",
        "stop",
        "--out",
        str(tmp_path / "suite"),
        "--in",
        str(reconstructed),
        "--no-sensors",
    ]
    late = "from 3 s: the log ends at 6.6 s, too early for an impact at 7.0 s"
    for starts, why in ((["0.7", "3"], late), (["0.7", "6.6"], "a drive can begin at 0.5 to 6.6 s")):
        threat = ["--threat", "side"] if why == late else []
        assert main([*command, "--start", *starts, *threat]) == 2
        assert why in capsys.readouterr().err.splitlines()[-1]
        assert not (tmp_path / "suite").exists()  # the first start is not driven either
    assert main([*command, "--start", "0.7"]) == 0
    assert (tmp_path / "suite" / "report.html").is_file()
    assert main(["drive", "--agent", "stop", "--out", str(tmp_path / "other"), "--start", "1"]) == 2
    assert "--in RUN" in capsys.readouterr().err
    assert main([*command[:2], "disturbed", "--out", str(tmp_path / "other"), *command[5:]]) == 2
    assert "can drive only there" in capsys.readouterr().err
    assert main([*command, "--rig", "driving", "--seed", "2", "--no-scenarios"]) == 2
    assert "--seed, --rig, --no-scenarios: for routes through towns" in capsys.readouterr().err


def test_scores_of_threats_stand_in_the_summary(reconstructed: Path, tmp_path: Path) -> None:
    suite = DriveSuite(
        REPLAY, ReconstructedRoutes(str(reconstructed), threats=(Threat.STATIONARY,)), sensors=False
    )
    (drive,) = drive_suite(suite, tmp_path).drives.values()
    assert drive.threat is not None
    assert drive.threat.reference_mps == pytest.approx(world.EGO_SPEED_MPS, abs=0.1)
    assert drive.threat.impact_mps == pytest.approx(world.EGO_SPEED_MPS, abs=0.5)
    assert read_summary(tmp_path / "summary.json")["threats.stationary.collision_rate"] == 1.0
    assert drive.score.infractions[0].kind == "collision_vehicle"
    assert LogPath(tmp_path / drive.log, tmp_path / "maps").folder.is_dir()
