"""Rows of an index, on a log whose geometry is known in closed form."""

import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import torch
from small_towers import PlainTowers
from synthetic_log import EGO_SPEED_MPS

from foredrive.data import LogPath
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.lidar import read_sweep
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.search.crops import Crop
from foredrive.search.embedding import embed_frames, mean_direction, read_views
from foredrive.search.index import FrameIndex, IndexSettings, Part
from foredrive.search.query import Like
from foredrive.search.rows import FACTS, WHOLE, row_schema
from foredrive.search.sectors import Sector, blind_sectors
from foredrive.search.target import example_views
from foredrive.search.towers import Towers


@pytest.fixture(scope="module")
def rows(log: LogPath, towers: Towers) -> pa.Table:
    return embed_frames(Log(log), range(21), towers)


def test_there_is_a_row_for_each_moment_and_view(rows: pa.Table) -> None:
    assert rows.schema == row_schema(4)
    assert rows["view"].to_pylist() == [WHOLE, "ahead", "left"] * 21
    assert rows["t_s"].to_pylist()[::3] == pytest.approx([0.1 * n for n in range(21)])
    assert rows["ego_speed"].to_pylist() == pytest.approx([EGO_SPEED_MPS] * 63)
    assert rows["azimuth_deg"].to_pylist()[:3] == [None, pytest.approx(0), pytest.approx(90)]


def test_objects_are_counted_where_they_are(rows: pa.Table) -> None:
    whole, ahead, left = rows.slice(0, 3).to_pylist()
    assert (whole["n_car"], whole["n_truck"], whole["n_pedestrian"]) == (1, 1, 0)
    assert (ahead["n_car"], ahead["n_truck"]) == (1, 1)  # at 14, 4 and 8, -4 m
    assert (left["n_car"], left["n_truck"]) == (0, 0)


def test_what_the_log_does_not_tell_is_null(rows: pa.Table) -> None:
    first = rows.slice(0, 1).to_pylist()[0]
    assert [first[name] for name in ("caption", "weather", "place", "score_nll")] == [None] * 4


def test_the_joint_embedding_is_the_normalised_sum_of_the_others(rows: pa.Table) -> None:
    row = rows.slice(1, 1).to_pylist()[0]
    total = np.add(row["image"], row["lidar"])
    np.testing.assert_allclose(row["joint"], total / np.linalg.norm(total), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(row["image"]), 1, atol=1e-6)


def test_a_whole_scene_is_the_direction_between_its_sectors(rows: pa.Table) -> None:
    whole, ahead, left = rows.slice(0, 3).to_pylist()
    total = np.add(ahead["image"], left["image"])
    np.testing.assert_allclose(whole["image"], total / np.linalg.norm(total), atol=1e-6)


def test_a_mean_leaves_out_what_is_missing() -> None:
    one, none = np.array([0.6, 0.8], np.float32), np.full(2, np.nan, np.float32)
    np.testing.assert_allclose(mean_direction(np.stack([one, none])), one)
    assert np.isnan(mean_direction(np.stack([none, none]))).all()
    assert np.isnan(mean_direction(np.zeros((0, 2), np.float32))).all()


def test_parts_of_a_log_are_embedded_as_the_whole_is(rows: pa.Table, log: LogPath, towers: Towers) -> None:
    part = embed_frames(Log(log), [7, 9, 20], towers)
    again = pa.concat_tables([rows.slice(3 * n, 3) for n in (7, 9, 20)])
    assert part.select(FACTS.names).equals(again.select(FACTS.names))
    for name in ("image", "lidar", "joint"):
        ours, theirs = (np.array(table[name].to_pylist()) for table in (part, again))
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_a_sector_holds_the_returns_its_camera_can_see_and_looks_along_x(log: LogPath) -> None:
    opened = Log(log)
    views = read_views(opened, 0, 48, Crop.WHOLE, with_lidar=True)
    for view in views.values():
        assert view.sweep is not None
        points = view.sweep.points_ego
        assert len(points) > 100
        assert view.sweep.returned.all()
        azimuth = torch.atan2(points[:, 1], points[:, 0])
        assert azimuth.abs().quantile(0.9) < math.radians(50)  # 90° wide, seen from the axle


def test_a_return_beside_the_crop_of_the_image_is_left_out(log: LogPath) -> None:
    opened = Log(log)
    found = read_sweep(opened, 0)
    assert found is not None
    points = found[0].points_ego[found[0].valid & found[0].returned]
    whole, square = (read_views(opened, 0, 24, crop, with_lidar=True) for crop in Crop)
    for name, metadata in pinhole_cameras(opened).items():
        view = square[name]
        assert view.image is not None
        assert view.sweep is not None
        assert view.image.shape[-2:] == (24, 24)
        full = read_camera(opened, 0, metadata, (24, 48), with_image=True)
        assert full.image is not None
        assert torch.equal(view.image, full.image[..., 12:36])
        uv, _, inside = project(
            transform_points(inverse_se3(full.T_ego_cam), points), full.K, full.dist, (24, 48)
        )
        expected = points[inside & (uv[:, 0] >= 12) & (uv[:, 0] < 36)]
        assert len(view.sweep.valid) == len(expected) < int(inside.sum())
        across = whole[name].sweep
        assert across is not None
        assert len(across.valid) == int(inside.sum())
        torch.testing.assert_close(
            view.sweep.points_ego.norm(dim=-1), expected.norm(dim=-1), atol=1e-4, rtol=1e-5
        )


def test_the_crop_of_towers_applies_to_a_part_of_an_image(log: LogPath) -> None:
    class SquareTowers(PlainTowers):
        crop = Crop.MIDDLE_SQUARE

    like = Like(str(log.folder), 0.0, "ahead", (10, 4, 70, 44))
    (part,) = example_views(None, like, SquareTowers()).views.values()
    opened = Log(log)
    camera = read_camera(opened, 0, pinhole_cameras(opened)["ahead"], (48, 96), with_image=True)
    assert camera.image is not None
    assert part.image is not None
    assert torch.equal(part.image, camera.image[:, 4:44, 20:60])
    assert part.sector.camera is not None
    torch.testing.assert_close(part.sector.camera.K[:2, 2], camera.K[:2, 2] - torch.tensor([20.0, 4.0]))


def test_the_name_of_an_indexed_log_is_taken_literally(
    log: LogPath, rows: pa.Table, towers: Towers, tmp_path: Path
) -> None:
    index = FrameIndex.make(str(tmp_path), IndexSettings(towers.name, towers.fingerprint, towers.dim, 0.5))
    column = rows.schema.get_field_index("log")
    for name in ("train/a_b", "train/a-b", "train/a%b", "train/same", "val/same"):
        named = rows.slice(0, 3).set_column(column, "log", pa.array([name] * 3))
        key = pa.array([f"{name}@0"] * 3)
        named = named.set_column(rows.schema.get_field_index("key"), "key", key)
        index.add([(Part(name, 0, 0, "digest"), named)])

    def moment(name: str) -> tuple[str, int]:
        return example_views(index, Like(name, 0.0, WHOLE, None), towers).moment

    for name in ("a_b", "a-b", "a%b", "train/a_b", "val/same"):
        assert moment(name) == (log.name, Log(log).t_us[0])
    for name in ("a+b", "%b", "b", "_ame"):
        with pytest.raises(InputError, match="no log of this name"):
            moment(name)
    with pytest.raises(InputError, match="several logs have this name: train/same, val/same; add the split"):
        moment("same")


def test_sectors_without_cameras_share_every_return(log: LogPath) -> None:
    found = read_sweep(Log(log), 0)
    assert found is not None
    hits = found[0][found[0].returned]
    parts = [sector.sweep(hits) for sector in blind_sectors().values()]
    assert sum(len(part.valid) for part in parts) == len(hits.valid)
    left = Sector(0.5 * math.pi).sweep(hits)
    assert (left.points_ego[:, 0] > 0).all()
    behind = Sector(math.pi).sweep(hits)
    assert (behind.points_ego[:, 0] > 0).all()  # turned about, what lies behind lies ahead
