"""The page that shows a log and a run: served, stepped through, stopped."""

import contextlib
import socket
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import viser
from miniature import miniature, write_log
from PIL import Image
from test_task_pictures import agents

from foredrive.cli.main import main
from foredrive.data import CameraSpec, LogPath, Points
from foredrive.data import write_log as write_recorded
from foredrive.json_http import REQUEST_S
from foredrive.runs import Run, train_run
from foredrive.runs.evaluate.display import DisplayPrediction
from foredrive.scene import Trajectory, VoxelSpec
from foredrive.scene.agents import MapLines
from foredrive.view.log_frames import LogFrames
from foredrive.view.model_panel import (
    arrows,
    pinhole,
    show_agents,
    show_lines,
    show_true_classes,
    shown_voxels,
)
from foredrive.view.overview import CAPTION_PX, GAP_PX, VOXELS_WIDTH_PX, Overview, occupancy_with_paths
from foredrive.view.page import free_port
from foredrive.view.viewer import Viewer
from foredrive.view.voxel_drawing import pca_colours

SPEC = VoxelSpec((0.0, -1.0, 0.0), 1.0, (1, 2, 3))


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> LogPath:
    return write_log(tmp_path_factory.mktemp("logs"))


@pytest.fixture(scope="module")
def run(log: LogPath, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train_run(miniature(), [log], tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def viewer(log: LogPath, run: Run) -> Iterator[Viewer]:
    viewer = Viewer(LogFrames(log, 96, run), "localhost", 0)
    yield viewer
    viewer.close()


def node(viewer: Viewer, name: str):
    return viewer.server.scene.get_handle_by_name(name)


def test_the_page_is_served_until_it_is_closed(log: LogPath) -> None:
    viewer = Viewer(LogFrames(log, 96), "localhost", 0)
    with urllib.request.urlopen(viewer.url) as page:
        assert page.status == 200
        assert b"<html" in page.read().lower()
    viewer.close()
    for _ in range(100):
        try:
            socket.create_connection(("localhost", viewer.server.get_port()), 5).close()
        except ConnectionRefusedError:
            return
        time.sleep(0.1)
    pytest.fail("it still listens after 10 s")


@pytest.mark.parametrize(
    ("host", "origin", "status"),
    [
        (None, None, None),
        (None, "own", None),
        (None, "http://elsewhere.example", 403),
        (None, "null", 403),
        ("rebound.example:80", "http://rebound.example:80", 403),
    ],
)
def test_pages_of_other_sites_are_refused(
    viewer: Viewer, host: str | None, origin: str | None, status: int | None
) -> None:
    """Browsers let any page open a WebSocket to this machine."""
    port = viewer.server.get_port()
    asked = f"viser-v{viser.__version__}"
    sent = {"Origin": f"http://localhost:{port}" if origin == "own" else origin} if origin else {}
    with socket.create_connection(("localhost", port)) as connection:
        lines = [
            "GET / HTTP/1.1", f"Host: {host or f'localhost:{port}'}", "Connection: Upgrade",
            "Upgrade: websocket", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Protocol: {asked}",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", *(f"{k}: {v}" for k, v in sent.items()),
        ]  # fmt: skip
        connection.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        answer = connection.recv(1000).split(b"\r\n")[0].decode()
    assert answer.split(" ")[1] == str(status or 101)


@pytest.mark.parametrize("sent", [b"", b"G", b"GET / HTTP/1.1\r\nHost: "])
def test_the_page_is_served_beside_two_hundred_bad_clients(
    viewer: Viewer, sent: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    with contextlib.ExitStack() as stack:
        clients = []
        for _ in range(200):
            clients.append(
                stack.enter_context(socket.create_connection(("localhost", viewer.server.get_port()), 20))
            )
            with contextlib.suppress(OSError):  # closed for the next ones
                clients[-1].sendall(sent)
        began_s = time.monotonic()
        with urllib.request.urlopen(viewer.url, timeout=20) as page:
            assert page.status == 200
        # A server that waits for one of them waits REQUEST_S
        assert time.monotonic() - began_s < REQUEST_S / 2
        with contextlib.suppress(ConnectionResetError):
            assert clients[0].recv(1) == b""
    with socket.create_connection(("localhost", viewer.server.get_port()), 20) as mad:
        mad.sendall(b"\x16\x03\x01" + bytes(200) + b"\r\n\r\n")
        mad.recv(1000)
    assert capfd.readouterr() == ("", "")


def test_a_frame_that_is_asked_for_too_late_is_not_drawn(log: LogPath) -> None:
    viewer = Viewer(LogFrames(log, 96), "localhost", 0)
    viewer.close()
    while viewer.server._websock_server._server_thread.is_alive():
        time.sleep(0.01)
    viewer._drawn = -1
    viewer._draw()  # as the slider's events that still wait do; the page's event loop is closed
    assert viewer._drawn == -1


def test_stepping_shows_what_was_sensed_then(viewer: Viewer) -> None:
    for index in (3, 20):
        viewer.show(index)
        clip = viewer.frames.clip(index)
        sweep = clip.sweeps[clip.now]
        points = sweep.points_ego[sweep.returned & sweep.valid].numpy()
        assert node(viewer, "/lidar").points == pytest.approx(points, abs=0.05)  # sent in half precision
        centres = node(viewer, "/boxes").points.reshape(2, 14, 2, 3)[:, :12].mean((1, 2))
        assert centres == pytest.approx(clip.boxes[clip.now].centre.numpy(), abs=1e-4)
        assert node(viewer, "/cameras/left").position == pytest.approx((0.8, 0.5, 1.5), abs=1e-5)
    assert np.ptp(node(viewer, "/driven").points[..., 0]) > 5  # 5 m/s ahead for up to 3 s


def test_layers_stay_hidden_while_time_goes_on(viewer: Viewer) -> None:
    viewer.layers["lidar"].value = False
    viewer.show(7)
    assert not node(viewer, "/lidar").visible
    viewer.layers["lidar"].value = True
    assert node(viewer, "/lidar").visible


def test_the_model_is_shown_where_it_has_seen_enough(viewer: Viewer) -> None:
    viewer.show(2)  # at 0.2 s; the model wants to have seen 0.5 s
    assert viewer.frames.prediction(2) is None
    viewer.show(10)
    prediction = viewer.frames.prediction(10)
    assert prediction is not None
    panel = viewer.model
    assert panel is not None
    panel.min_height_m.value = panel.spec.lower_m[2]  # by default the road is left out
    for k in (0, 2):
        above = float(prediction.occupancy_logit[k].sigmoid().median())
        panel.frame.value, panel.above.value = k, above
        shown = shown_voxels(prediction, k, panel.spec, above, panel.spec.lower_m[2])
        cubes = node(viewer, "/occupancy")
        assert len(cubes.batched_positions) == int(shown.sum()) > 0
        assert cubes.position == pytest.approx(prediction.T_now_ego[k, :3, 3].numpy(), abs=1e-6)
    assert len(node(viewer, "/plan").points) == 6
    panel.above.value = 1.0
    assert node(viewer, "/occupancy") is None
    panel.above.value = above
    viewer.show(2)
    assert not node(viewer, "/occupancy").visible
    assert not node(viewer, "/plan").visible


def test_what_a_camera_renders_is_what_evaluation_renders(log: LogPath, run: Run) -> None:
    from foredrive.data import ClipDataset, collate
    from foredrive.runs.evaluate.predict import AgentPredictor

    frames = LogFrames(log, 96, run)
    prediction, predictor = frames.prediction(10), frames.predictor
    assert prediction is not None
    assert predictor is not None
    dataset = ClipDataset([log], run.recipe.clips, None)
    at = next(k for k in range(len(dataset)) if dataset.now_us(k) == frames.now_us[10])
    observed = collate([dataset[at]]).clip.observed()
    expected = (
        AgentPredictor(predictor.agent, 2, ray_stride=4).predict(observed, frozenset({"images"})).images
    )
    assert expected is not None
    whole = predictor.render(prediction, 0, observed.rig[0, -1])
    assert whole[:, 2::4, 2::4].permute(0, 3, 1, 2).numpy() == pytest.approx(expected[0, 0].numpy(), abs=1e-5)


def some_vision(flow: torch.Tensor) -> DisplayPrediction:
    """Nothing but motion: the vehicle goes 2 m ahead and turns left by 90°."""
    turned = torch.eye(4)
    turned[:2, :2], turned[0, 3] = torch.tensor([[0.0, -1.0], [1.0, 0.0]]), 2.0
    nothing = torch.zeros(2, *SPEC.shape_zyx)
    plan = Trajectory(torch.zeros(1, 1, 2), torch.zeros(1, 1), torch.ones(1, 1).bool(), torch.zeros(1), 0.5)
    return DisplayPrediction(nothing, nothing[:, None], torch.stack([torch.eye(4), turned]), flow, plan)


def test_what_stands_still_has_no_arrow_however_the_vehicle_goes() -> None:
    start, end = some_vision(torch.zeros(1, 3, 1, 2, 3)).movement_m(1, SPEC)
    assert start == pytest.approx(end)
    assert end[0, 1, 0].tolist() == pytest.approx([1.5, 0.5, 0.5])  # (0.5, 0.5) there: left of where it went


def test_arrows_lead_from_where_things_were() -> None:
    """What warping by `warp_volume` gathers from z + f is drawn as going from there to z."""
    flow = torch.zeros(1, 3, 1, 2, 3)
    flow[:, 0] = -1.0
    start, end = some_vision(flow).movement_m(1, SPEC)
    assert (end - start)[0, 0, 0].tolist() == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)  # its x is now's y


def test_arrow_heads_end_at_the_tip() -> None:
    lines = arrows(torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[2.0, 0.0, 1.0]]))
    assert lines[:, 1].tolist() == [[2.0, 0.0, 1.0]] * 3
    assert lines[0, 0].tolist() == [0.0, 0.0, 1.0]
    assert lines[1, 0].tolist() == pytest.approx([1.4, 0.3, 1.0])
    assert lines[2, 0].tolist() == pytest.approx([1.4, -0.3, 1.0])


def test_features_that_differ_get_colours_that_differ() -> None:
    volume = torch.zeros(4, 1, 2, 4)
    volume[0, 0, 0], volume[1, 0, 1] = 1.0, 1.0
    colours = pca_colours(volume, torch.ones(1, 2, 4).bool())
    assert (colours[0, 0] == colours[0, 0, 0]).all()
    assert np.abs(colours[0, 0, 0].astype(int) - colours[0, 1, 0]).max() > 200
    assert (pca_colours(volume, torch.zeros(1, 2, 4).bool()) == 128).all()


def test_a_camera_of_one_s_own_sees_as_wide_as_the_window() -> None:
    rig = pinhole(np.eye(4), np.pi / 2, 2.0, 100)
    assert rig.size_hw == (100, 200)
    K = np.array([[50.0, 0, 100], [0, 50, 50], [0, 0, 1]])
    assert rig.K[0].numpy() == pytest.approx(K)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--t", "9"], "no time 9 s in this log"),
        (["--run", "{tmp}"], "{tmp}: not a run folder"),
        (["--run", "{tmp}", "--save", "{tmp}/x.png"], "{tmp}: not a run folder"),
        (["--host", "no-such-host.invalid"], "cannot serve a page at no-such-host.invalid"),
        (["--port", "70000"], "--port must be a number from 1 to 65535, got 70000"),
    ],
)
def test_what_cannot_be_shown_is_one_line(
    flags: list[str], said: str, log: LogPath, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(log.folder), *(flag.format(tmp=tmp_path) for flag in flags)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert said.format(tmp=tmp_path) in err
    assert list(tmp_path.iterdir()) == []


def test_a_port_that_is_taken_is_passed_over() -> None:
    with socket.create_server(("localhost", 0)) as taken:
        port = int(taken.getsockname()[1])
        assert free_port("localhost", port) > port


def test_what_heads_find_is_shown_and_cleared(viewer: Viewer) -> None:
    scene = viewer.server.scene
    classes = torch.full(SPEC.shape_zyx, 17, dtype=torch.uint8)
    classes[0, 0, 0] = 4
    for _ in range(2):  # a second time in place of the first
        show_agents(scene, agents([0.9, 0.1, 0.5], [4, 5, -1], [0.6, 0.4]))
        show_lines(scene, MapLines(torch.zeros(2, 3, 2), torch.tensor([0, 2]), torch.tensor([0.9, 0.1])))
        show_true_classes(scene, classes, "occ3d", SPEC, 0.0)
    assert node(viewer, "/found boxes/name 1") is not None
    assert node(viewer, "/found boxes/name 2") is None  # of three agents, two are likely
    assert node(viewer, "/found map") is not None
    assert node(viewer, "/true voxels") is not None
    show_agents(scene, None)
    show_lines(scene, None)
    show_true_classes(scene, None, "occ3d", SPEC, 0.0)
    for name in ("/found boxes", "/found boxes/lines", "/found map", "/true voxels"):
        assert node(viewer, name) is None


def test_the_picture_of_a_run_shows_its_occupancy_and_plan(log: LogPath, run: Run, tmp_path: Path) -> None:
    """The right part is the drawing of what the model predicts then."""
    frames = LogFrames(log, 640, run)
    index = frames.nearest(None)
    prediction = frames.prediction(index)
    assert prediction is not None
    arguments = ["view", str(log.folder), "--save", str(tmp_path / "x.png")]
    assert main([*arguments, "--run", str(run.folder)]) == 0
    picture = np.asarray(Image.open(tmp_path / "x.png").convert("RGB")).astype(int)
    occupied, plan = prediction.occupancy_logit[0] > 0, prediction.plan
    shown = Overview("", frames.clip(index), occupied, plan, run.recipe.clips.voxels)
    height = picture.shape[0] - CAPTION_PX - GAP_PX
    drawn = occupancy_with_paths(shown, (height, VOXELS_WIDTH_PX)).astype(int)
    place = picture[CAPTION_PX : CAPTION_PX + height, -VOXELS_WIDTH_PX - GAP_PX : -GAP_PX]
    assert np.abs(place - drawn).max() <= 1


def test_a_picture_of_a_run_needs_enough_frames_before(
    log: LogPath, run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = LogFrames(log, 640, run)
    assert frames.prediction(0) is None
    path = tmp_path / "x.png"
    told = ["view", str(log.folder), "--save", str(path), "--run", str(run.folder), "--t", "0"]
    assert main(told) == 2
    assert "too few frames before this one for the model" in capsys.readouterr().err
    assert not path.exists()


def test_a_log_is_opened_where_its_sensors_have_data(tmp_path: Path) -> None:
    """The middle has no sweep; one frame after it has no image; both are there 0.2 s after the middle."""
    camera = CameraSpec(
        "front",
        np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]], np.float32),
        np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]], np.float32),
        (24, 32),
    )
    frames, image = 11, np.full((24, 32, 3), 90, np.uint8)
    sweep = Points(np.array([[5.0, 0.0, 0.0], [6.0, 1.0, 0.5]]))
    log = write_recorded(
        tmp_path,
        "drive",
        t_s=0.1 * np.arange(frames),
        T_world_ego=np.tile(np.eye(4), (frames, 1, 1)),
        cameras=[camera],
        images={"front": [None if frame == 6 else image for frame in range(frames)]},
        sweeps=[None if frame in (3, 4, 5) else sweep for frame in range(frames)],
    )
    shown = LogFrames(log, 32)
    assert shown.t_s[shown.nearest(None)] == pytest.approx(0.7)
    assert shown.t_s[shown.nearest(0.5)] == pytest.approx(0.5)


@pytest.mark.parametrize("name", ["film.mp4", "x.png", "drive.bag"])
def test_a_file_that_is_no_log_is_told_what_view_opens(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(b"\x89 no log")
    assert main(["view", str(tmp_path / name)]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"foredrive: {tmp_path / name}: view opens the folder of a 123D log")
    assert "`foredrive convert`" in error
