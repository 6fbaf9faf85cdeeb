"""Planners and renderers in other processes: drives, sensors and failures over real loopback sockets."""

import base64
import io
import json
import subprocess
import sys
import time
import urllib.request
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_log as world
import torch
from PIL import Image

from foredrive.cli.main import main
from foredrive.driving.ncap.outcome import Outcome
from foredrive.engine.summary import read_summary
from foredrive.errors import InputError
from foredrive.integrations.remote import planner_client
from foredrive.json_http import Address, ask
from foredrive.json_server import JsonServer
from foredrive.methods.reconstruction.trust import TRUSTED_LOSS_DB
from foredrive.runs.drive.in_ncap import SafetyTests
from foredrive.runs.drive.in_reconstruction import opened_reconstruction
from foredrive.runs.drive.suite import DriveSuite, drive_suite
from foredrive.runs.reconstruction.trust import trust_of
from foredrive.runs.serve import alpasim_server_of, planner_of, renderer_of


def suite(agent: str, reconstructed: Path, scenarios: Path, runs: int = 1) -> DriveSuite:
    return DriveSuite(agent, SafetyTests((str(reconstructed),), str(scenarios), "paper", runs), sensors=False)


def test_a_planner_over_http_drives_as_it_does_here(
    reconstructed: Path, scenarios: Path, tmp_path: Path
) -> None:
    with JsonServer(planner_of("constant-velocity")).in_background() as address:
        remote = suite(f"http://{address}", reconstructed, scenarios)
        (over_wire,) = drive_suite(remote, tmp_path / "wire").drives.values()
    (here,) = drive_suite(
        suite("constant-velocity", reconstructed, scenarios), tmp_path / "here"
    ).drives.values()
    assert over_wire.threat is not None
    assert over_wire.threat == here.threat
    assert over_wire.threat.outcome is Outcome.COLLIDED
    again = drive_suite(remote, tmp_path / "wire")  # nothing is left to drive: nobody has to be alive
    assert again.skipped == 1


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ({"trajectory": [[float("nan"), 0.0]] * 6}, "not pairs of finite numbers"),
        ({"trajectory": [[1.0, 0.0]] * 3}, "3 points"),
        ({"trajectory": None}, "trajectory"),
        ("late", "no answer within 0.5 s"),
    ],
)
def test_an_agent_without_a_plan_is_a_counted_failure(
    answer: object, told: str, reconstructed: Path, scenarios: Path, tmp_path: Path
) -> None:
    """In its trial it drives nothing; a planner that breaks later has a failed drive."""
    resets, sound_resets = 0, 0

    def reset(_: object) -> bool:
        nonlocal resets
        resets += 1
        return True

    def infer(_: object) -> object:
        if resets <= sound_resets:
            return {"trajectory": [[0.5 * step, 0.0] for step in range(1, 7)]}
        if answer == "late":
            time.sleep(1.0)
        return answer

    answers: dict[tuple[str, str], Any] = {
        ("GET", "/alive"): lambda _: True,
        ("POST", "/reset"): reset,
        ("POST", "/infer"): infer,
    }
    with JsonServer(answers).in_background() as address:
        driven = suite(f"http://{address}?timeout=0.5", reconstructed, scenarios)
        with pytest.raises(InputError, match=f"in the trial at 0 s: .*{told}"):
            drive_suite(driven, tmp_path / "tried")
        assert not (tmp_path / "tried").exists()
        sound_resets = 2
        (drive,) = drive_suite(driven, tmp_path).drives.values()
    assert drive.threat is not None
    assert (drive.threat.outcome, drive.threat.score) == (Outcome.FAILED, None)
    assert told in drive.error
    summary = read_summary(tmp_path / "summary.json")
    assert (summary["threats.all.failed"], summary["threats.all.score"]) == (1, None)


def test_who_is_not_there_is_told_before_driving(
    reconstructed: Path,
    scenarios: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(planner_client, "check_planner", partial(planner_client.check_planner, within_s=0.1))
    with JsonServer({}).in_background() as address:
        pass
    command = [
        "ncap",
        str(reconstructed),
        "--scenarios",
        str(scenarios),
        "--out",
        str(tmp_path / "out"),
        "--runs",
        "1",
    ]
    assert main([*command, "--agent", f"http://{address}"]) == 2
    assert "no planner is alive" in capsys.readouterr().err
    assert main([*command, "--agent", "http://nowhere"]) == 2
    assert "not an address of the form http://HOST:PORT" in capsys.readouterr().err
    assert main([*command, "--agent", "nobody"]) == 2
    error = capsys.readouterr().err
    assert "unknown agent 'nobody'" in error
    assert "log, lidar-corridor" in error


def text_of(address: Address, path: str, body: object) -> bytes:
    request = urllib.request.Request(
        f"http://{address}{path}", json.dumps(body).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        content: bytes = answer.read()
    return content


def tensors(content: bytes) -> Any:
    return torch.load(io.BytesIO(base64.b64decode(content)), weights_only=True)


def test_the_renderer_serves_images_sweeps_and_actors(reconstructed: Path) -> None:
    """A client after neuro-ncap's `renderer_api.py`: it moves the parked car away and looks again."""
    opened = opened_reconstruction(str(reconstructed))
    with JsonServer(renderer_of(reconstructed)).in_background() as address:
        assert ask(address, "/alive") is True
        start_us = ask(address, "/start_time")
        assert start_us == world.START_US
        sensors = ask(address, "/sensors")
        assert sensors["cameras"] == ["ahead", "left"]
        actors = ask(address, "/get_actors")
        at_us = start_us + 1_000_000
        T_world_ego = world.ego_pose(1.0)
        pose = (T_world_ego @ np.array(sensors["camera2ego"][0])).tolist()
        asked = {"pose": pose, "timestamp": at_us, "camera_name": "ahead"}
        before = tensors(text_of(address, "/render_image", asked))
        here = ask(address, "/trust", asked)
        back = (T_world_ego @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.array(sensors["camera2ego"][0])).tolist()
        turned = ask(address, "/trust", {**asked, "pose": back})
        lidar = {"pose": (T_world_ego @ np.array(sensors["lidar2ego"])).tolist(), "timestamp": at_us}
        own = tensors(text_of(address, "/render_sweep", {**lidar, "lidar_name": sensors["lidars"][0]}))
        other = tensors(text_of(address, "/render_sweep", {**lidar, "lidar_name": "vlp16"}))
        (parked,) = [actor for actor in actors if abs(actor["poses"][0][1][3] - (-46.0)) < 0.5]
        parked["poses"] = [(np.array(each) + _shift(0.0, 30.0)).tolist() for each in parked["poses"]]
        assert ask(address, "/update_actors", [parked]) is None
        moved = ask(address, "/get_actors")
        after = tensors(text_of(address, "/render_image", asked))
        picture = Image.open(io.BytesIO(text_of(address, "/render_image", {**asked, "image_format": "png"})))
        gone = {**parked, "uuid": "nobody"}
        for body, told in (
            ([gone], "no actor 'nobody'"),
            ([parked, parked], "sent twice"),
            ([{**parked, "dims": [1, 2, 3]}], "keep their size"),
            ([{**parked, "timestamps": []}], "needs 1 to"),
        ):
            with pytest.raises(InputError, match=told):
                ask(address, "/update_actors", body)
        for change, told in (
            ({"camera_name": "CAM_UP"}, "no camera 'CAM_UP'; there are"),
            ({"timestamp": 5}, "is not in the log"),
            ({"pose": [[2.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "rigid"),
            ({"image_format": "gif"}, "image_format"),
        ):
            with pytest.raises(InputError, match=told):
                ask(address, "/render_image", {**asked, **change})
        with pytest.raises(InputError, match=r"no lidar 'radar'; there are: .*vlp16"):
            ask(address, "/render_sweep", {**lidar, "lidar_name": "radar"})
        with pytest.raises(InputError, match="twist has to be finite"):
            ask(address, "/render_sweep", {**lidar, "twist": [float("nan"), 0, 0, 0, 0, 0]})
    assert (before.dtype, before.shape) == (torch.uint8, (24, 48, 3))
    direct = opened.scene.camera(opened.scene.graph, _view(opened, 1.0)).rgb_8bit.permute(1, 2, 0)
    assert (before.int() - direct.int()).abs().max() <= 1
    assert not torch.equal(before, after)
    np.testing.assert_array_equal(np.asarray(picture), after.numpy())
    trust = trust_of(opened)
    view = _view(opened, 1.0)
    expected_db = trust.psnr_db(opened.scene.graph, [(view, opened.scene.camera(opened.scene.graph, view))])
    assert here["expected_psnr_db"] == pytest.approx(expected_db, abs=0.01)
    assert here["logged_psnr_db"] == pytest.approx(trust.reference_db)
    assert here["trusted"] == (expected_db >= trust.reference_db - TRUSTED_LOSS_DB)
    # Nobody looked back
    assert turned["expected_psnr_db"] < here["expected_psnr_db"]
    assert len(moved) == 1
    np.testing.assert_allclose(moved[0]["poses"][5], parked["poses"][5], atol=1e-3)
    assert moved[0]["dims"] == pytest.approx([2.0, 4.0, 2.0], abs=0.1)
    assert own["xyz"].shape == (len(own["intensity"]), 3)
    assert other["channel"].max() < 16
    assert float(own["time_s"].max()) <= 0.0


def _shift(x_m: float, y_m: float) -> np.ndarray:
    shift = np.zeros((4, 4))
    shift[:2, 3] = x_m, y_m
    return shift


def _view(opened: Any, t_s: float) -> Any:
    from foredrive.methods.reconstruction.novel_views import novel_camera_view
    from foredrive.methods.reconstruction.vehicle import EgoState

    ego = opened.vehicle.at(t_s)
    return novel_camera_view(opened.vehicle.rig, 0, EgoState(ego.T_scene_ego, torch.zeros(6), t_s))


def test_the_verb_serves_on_loopback_until_it_is_interrupted(reconstructed: Path) -> None:
    command = [sys.executable, "-m", "foredrive", "serve", "stop", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("stop is a planner at http://127.0.0.1:")
        process.terminate()
    for unfit in (["serve", "nobody"], ["serve", "expert"]):
        assert main(unfit) == 2


def test_a_driver_of_alpasim_drives_as_the_agent_does_here(
    reconstructed: Path, scenarios: Path, tmp_path: Path
) -> None:
    pytest.importorskip("carla_driver_interface")
    server, port = alpasim_server_of("constant-velocity", "127.0.0.1", 0)
    server.start()
    try:
        remote = suite(f"grpc://127.0.0.1:{port}", reconstructed, scenarios)
        (over_wire,) = drive_suite(remote, tmp_path / "wire").drives.values()
    finally:
        server.stop(grace=1.0).wait()
    (here,) = drive_suite(
        suite("constant-velocity", reconstructed, scenarios), tmp_path / "here"
    ).drives.values()
    assert over_wire.threat is not None
    assert here.threat is not None
    assert over_wire.threat.outcome is here.threat.outcome is Outcome.COLLIDED
    assert over_wire.threat.impact_mps == pytest.approx(here.threat.impact_mps, abs=0.01)
