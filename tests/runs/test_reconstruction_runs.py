"""Runs opened again without their logs, and actors that go from one to another."""

import dataclasses
import math
from pathlib import Path

import pytest
import synthetic_log as world
import torch
from builders import ONE_CAMERA

from foredrive.data import find_logs
from foredrive.errors import InputError
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.edits import Insert, Remove, apply_edits
from foredrive.methods.reconstruction.novel_views import novel_camera_view, novel_sweep_view, rendered_sweep
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.runs.reconstruction.reconstruct import Reconstruction, reconstruct
from foredrive.runs.reconstruction.reconstruction_run import edited_scene, open_reconstruction
from foredrive.runs.reconstruction.render import plan_frames, render_frame


@torch.no_grad()
def test_an_opened_scene_shows_the_same(small_run: Reconstruction) -> None:
    scene = open_reconstruction(small_run.folder).scene
    view = small_run.held_out.cameras[0]
    assert torch.equal(
        scene.camera(scene.graph, view).rgb,
        small_run.scene.camera(small_run.scene.graph, view).rgb,
    )


@torch.no_grad()
def test_a_view_that_is_asked_for_is_the_recorded_one(small_run: Reconstruction) -> None:
    """The vehicle drives at a constant speed, so that its poses between frames are known as well."""
    opened = open_reconstruction(small_run.folder)
    vehicle, recorded = opened.vehicle, small_run.held_out.cameras[1]
    assert vehicle.rig.names == ("ahead",)
    view = novel_camera_view(vehicle.rig, vehicle.camera("ahead"), vehicle.at(recorded.t_s))
    assert torch.allclose(view.T_scene_cam, recorded.T_scene_cam, atol=1e-4)
    assert torch.allclose(view.twist_cam, recorded.twist_cam, atol=1e-3)
    asked, judged = (opened.scene.camera(opened.scene.graph, v).rgb for v in (view, recorded))
    assert torch.allclose(asked, judged, atol=2e-3)
    between = vehicle.at(0.13)
    assert torch.allclose(between.T_scene_ego[:3, 3], torch.tensor([0.65, 0, 0]), atol=1e-4)
    left = between.shifted(matrix_from_yaw(torch.tensor(0.0), torch.tensor([0.0, 2.0, 0.0])))
    aside = novel_camera_view(vehicle.rig, 0, left.later(0.1))
    assert aside.t_s == pytest.approx(0.23)
    assert torch.allclose(aside.T_scene_cam[:3, 3], torch.tensor([1.15 + 1.6, 2.0, 1.5]), atol=1e-4)


@torch.no_grad()
def test_a_lidar_by_its_description_meets_what_the_recorded_one_met(
    small_run: Reconstruction,
) -> None:
    """Its channels, columns and reach are told from the recorded beams."""
    opened = open_reconstruction(small_run.folder)
    lidar = opened.vehicle.lidar
    assert lidar is not None
    assert torch.allclose(torch.tensor(lidar.elevation_rad), torch.linspace(-25, 5, 16).deg2rad(), atol=1e-4)
    assert lidar.azimuth_steps == 120
    assert lidar.rate_hz == pytest.approx(10)
    farthest_m = max(float(v.beams.range_m[v.beams.returned].max()) for v in small_run.held_out.sweeps)
    assert lidar.max_range_m == opened.vehicle.reach_m == pytest.approx(farthest_m, abs=1.0)
    view = novel_sweep_view(lidar, opened.vehicle.at(0.2))
    scene = opened.scene
    sweep = rendered_sweep(view, scene.sweep(scene.graph, scene.prepare_sweep(view), view.t_s))
    assert 0.1 < float(sweep.returned.float().mean()) <= 1
    steep = sweep.returned & (sweep.beam == 0)  # 25° down, from 1.8 m: never farther than the ground
    assert float(sweep.range_m[steep].median()) < 1.3 * 1.8 / math.sin(math.radians(25))


@torch.no_grad()
def test_nothing_beyond_a_lidars_reach_returns(small_run: Reconstruction) -> None:
    opened = open_reconstruction(small_run.folder)
    scene, view = opened.scene, small_run.held_out.sweeps[0]
    points = scene.prepare_sweep(view)
    far = scene.sweep(scene.graph, points, view.t_s)
    scene.reach_m = 10.0
    near = scene.sweep(scene.graph, points, view.t_s)
    assert float(far.hit_range_m[far.returned].max()) > 15
    assert float(near.hit_range_m[near.returned].max()) < 11
    lost = far.hit_range_m > 15
    assert float(near.returned[lost].float().mean()) < 0.05
    kept = far.hit_range_m < 5
    assert torch.equal(near.returned[kept], far.returned[kept])


def test_what_stands_belongs_to_the_static_part_and_is_an_obstacle(tmp_path: Path) -> None:
    """The box 7 stands and 11 moves. Static Gaussians begin on the faces of the one, not of the other."""
    (log,) = find_logs(world.write(tmp_path, frames=7))
    run = reconstruct(dataclasses.replace(ONE_CAMERA, moves_m=0.5), log, tmp_path / "run")
    assert (run.summary["actors"], run.summary["obstacles"]) == (1, 1)
    opened = open_reconstruction(run.folder)
    graph = opened.scene.graph
    assert graph.tracks.track_id.tolist() == [11]
    assert graph.all_tracks.track_id.tolist() == [11, 7]
    assert run.scene.graph.all_tracks.track_id.tolist() == [11, 7]
    static_m = graph.content.preview(STATIC).mean_m
    for box, fewest, most in ((world.PARKED, 20, math.inf), (world.MOVING, 0, 5)):
        # a decimetre of each face, without the ground below
        apart_m = (static_m - torch.from_numpy(box["centre"])).abs() - torch.from_numpy(box["size"] / 2)
        on_it = (apart_m.amax(-1).abs() < 0.1) & (static_m[:, 2] > 0.3)
        assert fewest <= int(on_it.sum()) <= most
    (film,) = (plan_frames(opened.vehicle, (), None, start_s=0.2, seconds=0.0),)
    frame = render_frame(opened.scene, opened.vehicle, apply_edits(graph, []), film, 0)
    assert frame.boxes.track_id.tolist() == [11, 7]
    with pytest.raises(InputError, match="7 is no actor of its own"):
        edited_scene(opened.scene, [Remove(7)])


@torch.no_grad()
def test_an_actor_of_another_run_is_where_one_of_this_was(small_run: Reconstruction) -> None:
    edits = [Insert(str(small_run.folder), actor=7, copy=70, follows=11), Remove(11)]
    edited = edited_scene(small_run.scene, edits)
    assert edited.graph.tracks.track_id.tolist() == [7, 70]
    view = small_run.held_out.cameras[0]
    before, after = (
        small_run.scene.camera(graph, view).rgb for graph in (small_run.scene.graph, edited.graph)
    )
    changed = (before - after).abs().amax(0) > 0.02
    assert 0 < float(changed.float().mean()) < 0.5  # the moving box, and nothing else
    assert float(changed[:, :24].float().mean()) < 0.02  # it is to the right


def test_what_is_no_finished_run_is_told(small_run: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a reconstruction folder"):
        open_reconstruction(tmp_path)
    (tmp_path / "config.yaml").write_bytes((small_run.folder / "config.yaml").read_bytes())
    with pytest.raises(InputError, match="not finished"):
        open_reconstruction(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match=r"no vehicle\.json\); reconstruct the log again"):
        open_reconstruction(tmp_path)
    (tmp_path / "vehicle.json").write_text("{}")
    with pytest.raises(InputError, match="does not describe a vehicle"):
        open_reconstruction(tmp_path)
    (tmp_path / "vehicle.json").write_bytes((small_run.folder / "vehicle.json").read_bytes())
    with pytest.raises(InputError, match="not the weights of a scene"):
        open_reconstruction(tmp_path)
