"""Films of a reconstructed log, from the command line."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch
from PIL import Image

from foredrive.cli.main import main
from foredrive.methods.reconstruction.edits import (
    Insert,
    Move,
    Remove,
    ShiftEgo,
    apply_edits,
    load_edits,
    save_edits,
)
from foredrive.runs.reconstruction import render as reconstructed_render
from foredrive.runs.reconstruction.reconstruct import Reconstruction
from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction
from foredrive.runs.reconstruction.render import edits_from_arguments, plan_frames, render_frame
from foredrive.view import reconstruction_video, video

FRAMES = 5
ONE_WH = (480 + 2 * 8, 270 - 30 + 8 + 240 + 2 * 26 + 8)
"""Of a film of one camera, whose images are twice as wide as high, over a view from above as high as that."""


def film(path: Path) -> list[np.ndarray]:
    with Image.open(path) as moving:
        frames = []
        for number in range(getattr(moving, "n_frames", 1)):
            moving.seek(number)
            frames.append(np.asarray(moving.convert("RGB")).astype(int))
    return frames


def test_the_verb_films_edited_beside_unedited(
    small_run: Reconstruction, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, saved = tmp_path / "new" / "film.webp", tmp_path / "edits.json"
    args = [
        "render",
        str(small_run.folder),
        "--out",
        str(out),
        "--remove",
        "11",
        "--shift-left",
        "1.5",
    ]
    assert main([*args, "--save-edits", str(saved), "--start", "0.2", "--seconds", "0.1"]) == 0
    assert f"wrote {out}: 2 frames" in capsys.readouterr().out
    frames = film(out)
    assert len(frames) == 2
    assert frames[0].shape[:2] == (ONE_WH[1], 2 * ONE_WH[0] - 8)
    # the moving box, right and ahead, is in the one picture alone
    left, right = frames[0][52:292, 8:488], frames[0][52:292, 496:976]
    green = np.array(world.MOVING_RGB) - world.GROUND_RGB

    def greenness(picture: np.ndarray) -> float:
        return float(((picture - world.GROUND_RGB) @ green / (green @ green)).max())

    assert greenness(left) > greenness(right) + 0.3
    assert load_edits(saved) == [Remove(11), ShiftEgo((0.0, 1.5, 0.0))]
    again = tmp_path / "again.webp"
    args = ["render", str(small_run.folder), "--out", str(again), "--edits", str(saved)]
    assert main([*args, "--start", "0.2", "--seconds", "0.1"]) == 0
    assert all((a == b).all() for a, b in zip(film(again), frames, strict=True))


def test_without_edits_there_is_one_picture(small_run: Reconstruction, tmp_path: Path) -> None:
    """As an MP4, at a rate that is no whole number."""
    out = tmp_path / "film.mp4"
    args = ["render", str(small_run.folder), "--out", str(out), "--colour", "height"]
    assert main([*args, "--rate-hz", "7.5"]) == 0
    av = pytest.importorskip("av")
    with av.open(str(out)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == ONE_WH
        assert sum(1 for _ in container.decode(stream)) == 4  # 0, 0.13, 0.27 and 0.4 s
        assert stream.average_rate == 7.5


def test_a_recorded_time_is_filmed_as_it_was_judged(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    judged = small_run.held_out.cameras[0]
    plan = plan_frames(opened.vehicle, start_s=judged.t_s, seconds=0.0)
    shot = render_frame(opened.scene, opened.vehicle, apply_edits(opened.scene.graph, []), plan, 0)
    with torch.no_grad():
        rgb = small_run.scene.camera(small_run.scene.graph, judged).rgb.clamp(0, 1)
    assert torch.allclose(shot.images[0].float(), 255 * rgb, atol=1.0)
    assert shot.boxes.track_id.tolist() == [7, 11]
    there = torch.tensor(world.PARKED["centre"] - world.driven(judged.t_s)).float()
    assert torch.allclose(shot.boxes.centre[0], there, atol=0.05)


def test_another_lidar_is_put_where_the_logs_was(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    plan = plan_frames(opened.vehicle, lidar="vlp16", start_s=0.2, seconds=0.0)
    assert plan.lidar is not None
    shot = render_frame(opened.scene, opened.vehicle, apply_edits(opened.scene.graph, []), plan, 0)
    assert shot.sweep is not None
    assert len(shot.sweep.beam) == 16 * plan.lidar.azimuth_steps
    last = shot.sweep.dt_s.abs() < 1e-4
    mounted = torch.tensor(world.LIDAR_EGO_M).float()
    assert torch.allclose(shot.sweep.origin_ego[last], mounted.expand(int(last.sum()), 3), atol=1e-3)


def test_times_are_those_that_are_asked_for(small_run: Reconstruction) -> None:
    vehicle = open_reconstruction(small_run.folder).vehicle
    assert plan_frames(vehicle).t_s == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    twice = plan_frames(vehicle, start_s=0.1, seconds=0.2, rate_hz=20.0)
    assert twice.t_s == pytest.approx([0.1, 0.15, 0.2, 0.25, 0.3])
    assert twice.step_s == pytest.approx(0.05)


def test_what_is_inserted_has_an_id_of_its_own(small_run: Reconstruction) -> None:
    tracks = small_run.scene.tracks
    edits = edits_from_arguments(tracks, [Insert("a", 1, 30, 7)], 0.0, [7], ["C:/x:7@11", "b:11@7"])
    assert edits == [Insert("C:/x", 7, 31, 11), Insert("b", 11, 32, 7), Remove(7)]
    own = edits_from_arguments(tracks, [], 0.0, [11], [f"{small_run.folder}:7@11"])
    assert edited_scene(small_run.scene, own).graph.tracks.track_id.tolist() == [7, 12]


def test_a_camera_has_all_names_by_which_a_log_has_it(small_run: Reconstruction) -> None:
    vehicle = open_reconstruction(small_run.folder).vehicle
    for name in ("ahead", "AHEAD", "pcam_f0", "PCAM_F0"):
        assert plan_frames(vehicle, (name,)).cameras == (0,)
    nameless = dataclasses.replace(vehicle, other_names=())
    assert plan_frames(nameless, ("Ahead",)).cameras == (0,)


def test_captions_say_what_was_changed() -> None:
    edits = [ShiftEgo((0.0, -2.0, 0.0)), Move(4, (1.0, 0.0, 0.0)), Remove(7), Remove(8)]
    assert (
        reconstruction_video.describe_edits(edits)
        == "edited: 2 m to the right, 4 moved, without 7, and 1 more"
    )


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--remove", "3"], "no actor 3; there are: 7, 11"),
        (["--insert", "{run}:7"], "written RUN:ACTOR@WAY"),
        (["--insert", "{tmp}:7@11"], "{tmp}: not a reconstruction folder"),
        (["--cameras", "behind"], "no reconstructed camera 'behind'; there are: ahead (pcam_f0)"),
        (["--start", "7"], "7 s is not in the log, which lasts from 0 s to 0.4 s"),
        (["--start", "0.2", "--seconds", "1"], "1.2 s is not in the log"),
        (["--rate-hz", "-5"], "--rate-hz must be a number above 0, got -5"),
        (["--edits", "{tmp}/none.json"], "{tmp}/none.json: no such file"),
        (["--out", "/proc/none/film.webp"], "/proc/none: no folder can be made there"),
        (["--out", "{tmp}/film.avi"], "{tmp}/film.avi: videos end on .mp4"),
    ],
)
def test_what_cannot_be_filmed_is_one_line(
    small_run: Reconstruction,
    args: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    args = [arg.format(tmp=tmp_path, run=small_run.folder) for arg in args]
    if "--out" not in args:
        args += ["--out", str(tmp_path / "film.webp")]
    assert main(["render", str(small_run.folder), *args]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert said.format(tmp=tmp_path) in error
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_film_leaves_nothing(
    small_run: Reconstruction,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Ctrl-C while the video is written, over one that is there already."""

    def write_some(path: Path, *_: object) -> None:
        path.write_bytes(b"half")
        raise KeyboardInterrupt

    out = tmp_path / "film.mp4"
    out.write_bytes(b"the film before")
    monkeypatch.setattr(video, "_write_mp4", write_some)
    assert main(["render", str(small_run.folder), "--out", str(out), "--seconds", "0.1"]) == 130
    assert out.read_bytes() == b"the film before"
    assert list(tmp_path.iterdir()) == [out]


def test_a_saved_edit_is_not_written_before_it_is_known_to_work(
    small_run: Reconstruction, tmp_path: Path
) -> None:
    save_edits([Remove(3)], tmp_path / "bad.json")
    args = ["render", str(small_run.folder), "--out", str(tmp_path / "film.webp")]
    assert (
        main([*args, "--edits", str(tmp_path / "bad.json"), "--save-edits", str(tmp_path / "new.json")]) == 2
    )
    assert not (tmp_path / "new.json").exists()


def test_lidars_have_names() -> None:
    assert set(reconstructed_render.LIDARS) == {"pandar64", "hdl32e", "vlp16"}
