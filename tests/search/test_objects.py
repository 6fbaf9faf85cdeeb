"""Crops of annotated objects, on a log whose geometry is known in closed form; prompts of zero-shot."""

import pytest
import torch

from foredrive.data import LogPath
from foredrive.data.boxes import read_boxes
from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.logs import Log
from foredrive.geometry.boxes import box_corners, points_in_boxes
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, matrix_from_yaw, transform_points
from foredrive.scene import Category
from foredrive.search.objects import MIN_RETURNS, read_objects
from foredrive.search.prompts import OBJECT_TEMPLATES, PERIOD_TEMPLATES, WEATHER_TEMPLATES

FRAME, CAR = 10, 0


def test_an_object_is_its_crop_and_the_returns_in_its_box(log: LogPath) -> None:
    opened = Log(log)
    (car,) = read_objects(opened, FRAME, 24)
    assert car.category is Category.CAR
    boxes = read_boxes(opened, FRAME)
    assert boxes is not None
    box = boxes[boxes.valid & (boxes.category == Category.CAR)]
    assert len(box.valid) == 1
    sweep = car.view.sweep
    assert sweep is not None
    assert len(sweep.valid) >= MIN_RETURNS
    turned_back = transform_points(
        matrix_from_yaw(torch.tensor(car.view.sector.azimuth_rad), torch.zeros(3)), sweep.points_ego
    )
    inside = points_in_boxes(turned_back, box.centre, box.size_lwh + 1e-3, box.yaw)
    assert inside.all()

    assert car.view.image is not None
    assert car.view.image.shape == (3, 24, 24)
    side, across = car.view.sector.size_hw
    assert side == across  # a square around the box
    corners = box_corners(box.centre, box.size_lwh, box.yaw)[0]
    assert car.view.sector.contains(corners).float().mean() >= 0.5
    found = []
    for metadata in pinhole_cameras(opened).values():
        camera = read_camera(opened, FRAME, metadata, (metadata.height, metadata.width), with_image=True)
        uv, _, seen = project(
            transform_points(inverse_se3(camera.T_ego_cam), corners),
            camera.K,
            camera.dist,
            (metadata.height, metadata.width),
        )
        if seen.all():
            found.append(float((uv.amax(0) - uv.amin(0)).max()))
    assert len(found) == 1
    assert side == pytest.approx(found[0], abs=1.0)


def test_the_templates_are_those_of_the_paper() -> None:
    assert (len(OBJECT_TEMPLATES), len(WEATHER_TEMPLATES), len(PERIOD_TEMPLATES)) == (85, 132, 192)
    for templates in (OBJECT_TEMPLATES, WEATHER_TEMPLATES, PERIOD_TEMPLATES):
        assert len(set(templates)) == len(templates)
        assert all(template.count("{}") == 1 and template.endswith(".") for template in templates)
    assert {"itap of a {}.", "a {} in a video game.", "a photo of the hard to see {}."} < {*OBJECT_TEMPLATES}
    assert "a bad photo of a {} environment." in WEATHER_TEMPLATES
    assert "a good photo of many things in a street captured at {}." in PERIOD_TEMPLATES
