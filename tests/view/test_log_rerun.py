"""Files of Rerun: read back with Rerun's own reader, and compared with the log, the run and the scene."""

import dataclasses
import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import synthetic_log
import test_maps
from miniature import write_log
from PIL import Image

from foredrive.cli.main import main
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import encoded_image, pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.log_paths import find_logs
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.maps import read_map_patch
from foredrive.errors import InputError
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.runs.reconstruction.reconstruction_run import open_reconstruction, open_run_log
from foredrive.view.log_contents import FrameContent, log_contents
from foredrive.view.log_frames import LogFrames

if TYPE_CHECKING:
    from foredrive.runs import Run
    from foredrive.runs.reconstruction.reconstruct import Reconstruction

FRAMES = 6
Row = dict[str, Any]


def test_without_the_package_it_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["export", "rerun", str(tmp_path), "--out", str(tmp_path / "log.rrd")]) == 2
    said = "foredrive: Rerun's files need the package rerun-sdk: pip install 'foredrive[rerun]'\n"
    assert capsys.readouterr().err == said


def rows(file: Path) -> dict[str, list[tuple[int | None, Row]]]:
    """Return time (µs; None: static) and components of each row by entity, in the order of time."""
    chunk = pytest.importorskip("rerun.chunk")
    by_entity: dict[str, list[tuple[int | None, Row]]] = {}
    for part in chunk.RrdReader(file).stream().to_chunks():
        for row in part.to_record_batch().to_pylist():
            t_us = None if "time" not in row else int(np.datetime64(row["time"], "us").astype(np.int64))
            own = {name: value for name, value in row.items() if ":" in name}
            by_entity.setdefault(part.entity_path, []).append((t_us, own))
    return {entity: sorted(of_entity, key=lambda row: row[0] or 0) for entity, of_entity in by_entity.items()}


def at(of_entity: list[tuple[int | None, Row]], t_us: int) -> Row:
    """Return all components that an entity has at a time of its own."""
    return {name: value for when, row in of_entity if when == t_us for name, value in row.items()}


def matrix(row: Row) -> np.ndarray:
    """Return the pose of a row; matrices are stored column by column."""
    T = np.eye(4)
    T[:3, :3] = np.reshape(row["Transform3D:mat3x3"][0], (3, 3)).T
    T[:3, 3] = row["Transform3D:translation"][0]
    return T


def test_a_log_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rerun")
    path = write_log(tmp_path / "data", frames=FRAMES)
    file = tmp_path / "log.rrd"
    assert main(["export", "rerun", str(path.folder), "--out", str(file)]) == 0
    assert f"wrote {file} with world, world/ego, world/ego/boxes, " in capsys.readouterr().out
    log, shown = Log(path), rows(file)
    assert [t_us for t_us, _ in shown["/world/ego"]] == log.t_us.tolist()
    t_us = int(log.t_us[2])
    np.testing.assert_allclose(matrix(at(shown["/world/ego"], t_us)), log.T_world_ego[2], atol=1e-4)
    for name, camera in pinhole_cameras(log).items():
        size_hw = (camera.height, camera.width)
        read = read_camera(log, 2, camera, size_hw, with_image=False)
        own = at(shown[f"/world/ego/cam/{name}"], t_us)
        np.testing.assert_allclose(matrix(own), read.T_ego_cam.numpy(), atol=1e-6)
        K = np.reshape(own["Pinhole:image_from_camera"][0], (3, 3)).T
        np.testing.assert_allclose(K, read.K.numpy(), rtol=1e-6)
        assert own["Pinhole:resolution"][0] == [camera.width, camera.height]
        (blob,) = at(shown[f"/world/ego/cam/{name}/image"], t_us)["EncodedImage:blob"]
        assert bytes(blob) == encoded_image(log, 2, camera)
        assert Image.open(io.BytesIO(bytes(blob))).size == (camera.width, camera.height)
    boxes, own = read_boxes(log, 2), at(shown["/world/ego/boxes"], t_us)
    assert boxes is not None
    np.testing.assert_allclose(own["Boxes3D:centers"], boxes.centre.numpy(), atol=1e-6)
    np.testing.assert_allclose(own["Boxes3D:half_sizes"], 0.5 * boxes.size_lwh.numpy(), atol=1e-6)
    x, y, z, w = np.array(own["Boxes3D:quaternions"]).T
    np.testing.assert_allclose(np.exp(1j * np.arctan2(z, w)) ** 2, np.exp(1j * boxes.yaw.numpy()), atol=1e-6)
    assert not x.any()
    assert not y.any()
    assert own["Boxes3D:labels"][0] == f"car {int(boxes.track_id[0])}"
    sweep = read_sweep(log, 2)
    assert sweep is not None
    points = sweep[0][sweep[0].valid & sweep[0].returned].points_ego.numpy()
    np.testing.assert_allclose(at(shown["/world/ego/lidar"], t_us)["Points3D:positions"], points, atol=1e-6)
    ((driven,),) = (at(shown["/world/ego/driven"], int(log.t_us[0]))["LineStrips3D:strips"],)
    assert driven[0] == [0.0, 0.0, 0.0]
    step = np.linalg.inv(log.T_world_ego[0]) @ log.T_world_ego[5]
    assert driven[1][:2] == pytest.approx(step[:2, 3].tolist(), abs=1e-4)


def test_the_blueprint_shows_all_cameras(tmp_path: Path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    path = write_log(tmp_path / "data", frames=FRAMES)
    write(path, tmp_path / "log.rrd")
    reader = chunk.RrdReader(tmp_path / "log.rrd")
    assert [entry.application_id for entry in reader.blueprints()] == ["foredrive"]
    batches = [
        part.to_record_batch().to_pylist() for part in reader.stream(store=reader.blueprints()[0]).to_chunks()
    ]
    origins = [row.get("ViewBlueprint:space_origin") for batch in batches for row in batch]
    names = pinhole_cameras(Log(path))
    wanted = {"world", *(f"world/ego/cam/{name}" for name in names)}
    assert {str(origin[0]).strip("/") for origin in origins if origin} == wanted


def write(path: Any, file: Path, *others: Any) -> list[str]:
    """Write a log; Rerun is imported late, because it may be missing."""
    from foredrive.view.log_rerun import write_log_rerun

    return write_log_rerun(path, file, *others)


def test_what_a_frame_lacks_is_cleared(tmp_path: Path) -> None:
    """Rerun shows the latest data of each entity: a sweep of before would move with the vehicle."""
    pytest.importorskip("rerun")
    cameras = synthetic_log.cameras()
    with LogWriter(tmp_path / "data", "flat_train", "log", cameras, None, None, None) as writer:
        for step in range(3):
            frame = synthetic_log.frame(step, cameras)
            if step == 1:
                frame = dataclasses.replace(
                    frame, sweep=None, images={"ahead": frame.images["ahead"]}, boxes=None
                )
            writer.write(frame)
    (path,) = find_logs(tmp_path / "data")
    write(path, tmp_path / "log.rrd")
    shown, log = rows(tmp_path / "log.rrd"), Log(path)
    for entity in ("lidar", "boxes", "cam/left/image"):
        own = [at(shown[f"/world/ego/{entity}"], int(t_us)) for t_us in log.t_us]
        assert ["Clear:is_recursive" in row for row in own] == [False, True, False], entity
    assert all("EncodedImage:blob" in at(shown["/world/ego/cam/ahead/image"], int(t_us)) for t_us in log.t_us)


@pytest.mark.parametrize("far_m", [0.0, 4_000_000.0])
def test_the_map_is_in_the_world_and_far_worlds_are_moved(
    far_m: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In single precision, a place 4,000 km from the origin would be known to a quarter of a metre."""
    pytest.importorskip("rerun")
    monkeypatch.setattr(
        synthetic_log, "WORLD_OFFSET", synthetic_log.WORLD_OFFSET + np.array([far_m, 0.0, 0.0])
    )
    data = tmp_path / "data"
    log = Log(write_log(data, frames=FRAMES)) if far_m else test_maps.write_with_map(data)
    write(log.path, tmp_path / "log.rrd")
    shown = rows(tmp_path / "log.rrd")
    chunk = pytest.importorskip("rerun.chunk")
    parts = chunk.RrdReader(tmp_path / "log.rrd").stream().to_chunks()
    (properties,) = (part for part in parts if part.entity_path == "/__properties/foredrive")
    offset_m = np.array(properties.to_record_batch().to_pylist()[0]["world_offset_m"])
    assert (np.abs(offset_m).max() > 0) == bool(far_m)
    place = matrix(at(shown["/world/ego"], int(log.t_us[-1])))[:3, 3]
    np.testing.assert_allclose(place + offset_m, log.T_world_ego[-1, :3, 3], atol=1e-3)
    if not far_m:
        patch, T = read_map_patch(log, 0), log.T_world_ego[0]
        strips = at(shown["/world/map/0"], int(log.t_us[0]))["LineStrips3D:strips"]
        assert len(strips) == len(patch.kind)
        expected = patch.vertices[0][patch.valid[0]].double().numpy() @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(strips[0], expected, atol=1e-3)


def test_plans_and_occupancy_of_a_run(
    trained: "Run", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of a few steps finds nothing, so two voxels are filled in by hand."""
    pytest.importorskip("rerun")
    from foredrive.view import log_rerun

    log, spec, lonely = trained.logs[0], trained.recipe.clips.voxels, [(1, 2, 3), (0, 4, 5)]

    def filled(*given: Any) -> Iterator[FrameContent]:
        for content in log_contents(*given):
            if content.occupied is not None:
                content.occupied[tuple(zip(*lonely, strict=True))] = True
            yield content

    monkeypatch.setattr(log_rerun, "log_contents", filled)
    write(log, tmp_path / "run.rrd", trained)
    shown, frames = rows(tmp_path / "run.rrd"), LogFrames(log, 64, trained)
    predicted = frames.prediction(len(frames) - 1)
    assert predicted is not None
    t_us = frames.now_us[-1]
    own = at(shown["/world/ego/occupancy"], t_us)
    voxels_zyx = {*lonely, *map(tuple, (predicted.occupancy_logit[0] > 0).nonzero().tolist())}
    assert {tuple(index[::-1]) for index in own["VoxelGridMap:voxel_indices"]} == voxels_zyx
    assert own["VoxelGridMap:voxel_size"][0] == pytest.approx([spec.voxel_m] * 3)
    assert own["VoxelGridMap:translation"][0] == pytest.approx(list(spec.lower_m))
    ((plan,),) = (at(shown["/world/ego/plan"], t_us)["LineStrips3D:strips"],)
    expected = predicted.plan.xy[0][predicted.plan.valid[0]].numpy()
    np.testing.assert_allclose(np.array(plan)[1:, :2], expected, atol=1e-5)


def test_the_gaussians_of_a_reconstruction(small_run: "Reconstruction", tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    _, log = open_run_log(small_run.folder)
    opened = open_reconstruction(small_run.folder)
    write(log, tmp_path / "log.rrd", None, opened)
    shown, graph = rows(tmp_path / "log.rrd"), opened.scene.graph
    ((when, own),) = shown["/world/scene/static"]
    static = graph.content.preview(STATIC).map_tensors(lambda tensor: tensor.detach())
    assert when is None
    np.testing.assert_allclose(own["GaussianSplats3D:centers"], static.mean_m.numpy(), rtol=1e-6)
    np.testing.assert_allclose(own["GaussianSplats3D:scales"], static.log_scale.exp().numpy(), rtol=1e-5)
    x, y, z, w = np.array(own["GaussianSplats3D:quaternions"]).T
    unit = static.quaternion / static.quaternion.norm(dim=-1, keepdim=True)
    np.testing.assert_allclose(np.stack([w, x, y, z], -1), unit.numpy(), atol=1e-5)
    alpha = np.array(own["GaussianSplats3D:colors"], np.uint32) & 255  # 0xRRGGBBAA
    np.testing.assert_allclose(alpha / 255, static.opacity_logit.sigmoid().numpy(), atol=0.01)
    ((_, placed),) = shown["/world/scene"]
    np.testing.assert_allclose(matrix(placed), opened.vehicle.T_world_scene.numpy(), atol=1e-4)
    times_us = Log(log).t_us
    for row, number in enumerate(graph.tracks.track_id.tolist()):
        states = [states_at(graph.tracks, float(t_us - times_us[0]) * 1e-6) for t_us in times_us]
        there = [int(t_us) for t_us, state in zip(times_us, states, strict=True) if state.present[row]]
        assert [t_us for t_us, _ in shown.get(f"/world/scene/actor/{number}", [])] == there
        if there:
            state = states[times_us.tolist().index(there[-1])]
            last = matrix(at(shown[f"/world/scene/actor/{number}"], there[-1]))
            np.testing.assert_allclose(last, state.T_scene_actor[row].detach().numpy(), atol=1e-4)
            first = shown[f"/world/scene/actor/{number}/splats"][0][1]
            assert len(first["GaussianSplats3D:centers"]) == len(graph.content.preview(row).mean_m)


def test_what_does_not_fit_is_told(
    small_run: "Reconstruction", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun")
    monkeypatch.setattr(synthetic_log, "WORLD_OFFSET", synthetic_log.WORLD_OFFSET + 1.0)
    path = write_log(tmp_path / "data", frames=FRAMES)
    with pytest.raises(InputError, match=r"must end in \.rrd"):
        write(path, tmp_path / "log.txt")
    with pytest.raises(InputError, match="a reconstruction of another log than flat_train/flat"):
        write(path, tmp_path / "log.rrd", None, open_reconstruction(small_run.folder))
    assert not (tmp_path / "log.rrd").exists()


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = pytest.importorskip("rerun")
    path = write_log(tmp_path / "data", frames=FRAMES)

    def flush(stream: Any) -> None:
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rerun.RecordingStream, "flush", flush)
    with pytest.raises(InputError, match=r"log\.rrd: Rerun cannot write it; is the disk full\?"):
        write(path, tmp_path / "log.rrd")
    assert [file.name for file in tmp_path.iterdir()] == ["data"]
