"""The page that shows one time of a log, and the view from above on it."""

import dataclasses
from pathlib import Path

import matplotlib.colors
import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from PIL import Image
from scipy.ndimage import binary_erosion

from foredrive.scene import Clip, MapKind
from foredrive.view import palette
from foredrive.view.bev import draw_bev, draw_boxes, legend_handles, path_points, start_bev
from foredrive.view.log_sheet import camera_picture, camera_rows, write_log_sheet


def test_cameras_stand_as_around_the_car(clip: Clip) -> None:
    names = clip.rig.names
    rows = [[names[c] for c in row] for row in camera_rows(clip.rig[clip.now])]
    assert rows == [["front_left", "front", "front_right"], ["back_left", "back", "back_right"]]


def test_few_cameras_share_a_row_and_none_make_none(clip: Clip) -> None:
    rig = clip.rig[clip.now]
    pick = torch.tensor([2, 0])  # front right, front
    two = dataclasses.replace(rig[pick], names=("right", "front"))
    assert camera_rows(two) == [[1, 0]]
    none = dataclasses.replace(rig[torch.tensor([], dtype=torch.long)], names=())
    assert camera_rows(none) == []


def test_lidar_and_boxes_agree_with_the_image(clip: Clip) -> None:
    off = torch.zeros_like(clip.sweep_valid)
    size_hw = clip.rig.size_hw
    plain = camera_picture(dataclasses.replace(clip, sweep_valid=off, boxes_valid=off), 0, size_hw)
    dotted = camera_picture(dataclasses.replace(clip, boxes_valid=off), 0, size_hw)
    framed = camera_picture(dataclasses.replace(clip, sweep_valid=off), 0, size_hw)
    assert (plain == clip.images[clip.now, 0].permute(1, 2, 0).numpy()).all()
    sky = binary_erosion((plain == plain[0, 0]).all(-1), iterations=2)
    dots, frames = (dotted != plain).any(-1), (framed != plain).any(-1)
    assert dots.sum() > 200
    assert frames.sum() > 100
    assert not (dots & sky).any()  # nothing returns from the sky, and no box stands in it
    assert not (frames & sky).any()


def test_the_sheet_is_written_whole_and_at_full_size(clip: Clip, tmp_path: Path) -> None:
    path = tmp_path / "sheet.png"
    write_log_sheet(path, clip, "street")
    with Image.open(path) as sheet:
        assert sheet.width > 2400
        assert sheet.height > 700
    assert [p.name for p in tmp_path.iterdir()] == ["sheet.png"]


@pytest.mark.parametrize("missing", ["images", "cameras", "everything"])
def test_what_a_log_lacks_leaves_room_and_no_error(clip: Clip, tmp_path: Path, missing: str) -> None:
    shown = dataclasses.replace(clip, image_valid=torch.zeros_like(clip.image_valid))
    if missing != "images":
        none = torch.tensor([], dtype=torch.long)
        rig = dataclasses.replace(clip.rig[:, none], names=())
        shown = dataclasses.replace(
            shown, rig=rig, images=clip.images[:, none], image_valid=clip.image_valid[:, none]
        )
    if missing == "everything":
        shown = dataclasses.replace(
            shown,
            sweep_valid=torch.zeros_like(clip.sweep_valid),
            boxes_valid=torch.zeros_like(clip.boxes_valid),
            map=None,
        )
    write_log_sheet(tmp_path / "sheet.png", shown, "street")
    assert (tmp_path / "sheet.png").exists()


def test_from_above_x_points_up_and_y_left(clip: Clip) -> None:
    figure = Figure(figsize=(4, 4), dpi=100)
    ax = figure.add_axes((0, 0, 1, 1))
    draw_bev(ax, clip, 20.0)
    ahead, left = ax.transData.transform([(0, 10), (10, 0)])  # axes take (y, x)
    centre = ax.transData.transform((0, 0))
    np.testing.assert_allclose(ahead - centre, [0, 100], atol=1e-6)
    np.testing.assert_allclose(left - centre, [-100, 0], atol=1e-6)


def test_arrows_span_one_second_and_slow_or_unknown_boxes_have_none(clip: Clip) -> None:
    boxes = clip.boxes[clip.now]
    boxes = dataclasses.replace(boxes, velocity=boxes.velocity.clone())
    boxes.velocity[1] = float("nan")
    ax = Figure().add_subplot()
    start_bev(ax, 20.0)
    draw_boxes(ax, boxes)
    (arrows,) = [c for c in ax.collections if isinstance(c, Quiver)]
    np.testing.assert_allclose(arrows.XY, [[0.0, 12.0], [-5.5, 8.0]])  # car ahead, pedestrian: (y, x)
    np.testing.assert_allclose(arrows.V, [6.0, 1.4 * np.cos(1.6)], atol=1e-5)


def test_map_lines_take_the_colour_of_their_kind(clip: Clip) -> None:
    ax = Figure().add_subplot()
    draw_bev(ax, clip, 20.0)
    road_edge = matplotlib.colors.to_rgba(palette.MAP_COLOURS[MapKind.ROAD_EDGE])
    drawn = [c for c in ax.collections if isinstance(c, LineCollection) and len(c.get_segments())]
    edges = [c for c in drawn if np.allclose(c.get_color()[0], road_edge)]
    assert sorted(segment[0, 0] for c in edges for segment in c.get_segments()) == [-3.5, 6.0]


def test_the_legend_names_what_is_shown_and_no_more(clip: Clip) -> None:
    names = [str(handle.get_label()) for handle in legend_handles(clip)]
    assert "pedestrian" in names
    assert "crosswalk" in names
    assert "planned" not in names
    assert "walkway" not in names


def test_a_path_starts_at_the_vehicle_and_skips_invalid_waypoints(clip: Clip) -> None:
    valid = clip.future.valid.clone()
    valid[0, 4:] = False
    points = path_points(dataclasses.replace(clip.future, valid=valid))
    assert points.shape == (5, 3)
    assert points[0].tolist() == [0, 0, 0]
    torch.testing.assert_close(points[1:, :2], clip.future.xy[0, :4])
