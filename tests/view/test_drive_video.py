"""The scene from above in the film of a drive."""

import math

import numpy as np
import torch
from jaxtyping import Float64
from PIL import Image

from foredrive.driving.drive_record import PlanRecord
from foredrive.driving.speed_rule import FRONT_M
from foredrive.scene import Boxes, Category
from foredrive.scene.affordances import CELL_M
from foredrive.scene.boxes import unlabelled
from foredrive.scene.traffic_light import LightState
from foredrive.view import palette
from foredrive.view.drive_video import ABOVE_WH, EGO_AT_X, LIGHT_COLOURS, PX_PER_M, SEEN, draw_from_above

YAW = math.radians(120.0)
R = np.array([[math.cos(YAW), -math.sin(YAW)], [math.sin(YAW), math.cos(YAW)]])
T_WORLD_EGO = np.eye(4)
T_WORLD_EGO[:2, :2], T_WORLD_EGO[:2, 3] = R, (40.0, -7.0)


def world(points: list[list[float]]) -> Float64[np.ndarray, "N 2"]:
    """Return points of the ego frame in the world."""
    return np.array(points) @ R.T + T_WORLD_EGO[:2, 3]


def pixel(above: Image.Image, x_m: float, y_m: float) -> tuple[int, ...]:
    """Return the colour at a point of the ego frame."""
    x, y = EGO_AT_X * ABOVE_WH[0] + PX_PER_M * x_m, 0.5 * ABOVE_WH[1] - PX_PER_M * y_m
    colour = above.getpixel((round(x), round(y)))
    assert isinstance(colour, tuple)
    return colour


def is_like(colour: tuple[int, ...], wanted: str) -> bool:
    return bool(np.abs(np.subtract(colour, palette.rgb255(wanted))).max() < 90)


def test_a_stop_line_lies_across_the_road_ahead_in_the_colour_of_its_light() -> None:
    ends = world([[20.0, 2.0], [20.0, -2.0]])  # 20 m ahead
    route = world([[0.0, 0.0], [30.0, 0.0]])
    above = draw_from_above([], route, T_WORLD_EGO, None, [(LightState.RED, ends)])
    assert is_like(pixel(above, 20.0, 1.0), LIGHT_COLOURS[LightState.RED])
    assert is_like(pixel(above, 20.0, -1.0), LIGHT_COLOURS[LightState.RED])
    for x_m, y_m in ((20.0, 4.0), (17.0, 1.0), (-20.0, 1.0)):
        assert pixel(above, x_m, y_m) == palette.rgb255(palette.GROUND)


def test_plan_and_sight_are_drawn_along_the_route_from_the_bumper_on() -> None:
    # The route turns left by a right angle 20 m ahead, and began 10 m behind
    route = world([[-10.0, 0.0], [20.0, 0.0], [20.0, 30.0]])
    plan = PlanRecord(
        3.0,
        tuple(map(tuple, world([[0.0, 0.0], [4.0, 0.0], [8.0, -6.0]]).tolist())),
        LightState.YELLOW,
        20.0 - FRONT_M + 12.0,  # 12 m behind the turn
        (*[0.0] * 3, 0.6, 0.4, *[0.0] * 19),
    )
    above = draw_from_above([], route, T_WORLD_EGO, None, [], plan)
    assert is_like(pixel(above, 8.0, -6.0), palette.PLAN)
    fourth_m = FRONT_M + 3.5 * CELL_M
    assert is_like(pixel(above, fourth_m, 0.6), SEEN)
    assert not is_like(pixel(above, fourth_m + CELL_M, 0.6), SEEN)  # below the probability that is shown
    ring_m = 7.0 / PX_PER_M
    for x_m, y_m in ((20.0 + ring_m, 12.0), (20.0 - ring_m, 12.0), (20.0, 12.0 + ring_m)):
        assert is_like(pixel(above, x_m, y_m), LIGHT_COLOURS[LightState.YELLOW])
    assert not is_like(pixel(above, 20.0, 12.0), LIGHT_COLOURS[LightState.YELLOW])


def test_a_vehicle_that_was_sent_into_the_way_has_a_colour_of_its_own() -> None:
    boxes = Boxes(
        centre=torch.tensor([[15.0, 0.0, 0.8], [15.0, 8.0, 0.8]]),
        size_lwh=torch.tensor([[4.5, 1.9, 1.6]]).expand(2, 3),
        yaw=torch.zeros(2),
        velocity=torch.zeros(2, 2),
        category=torch.full((2,), int(Category.CAR)),
        track_id=torch.tensor([7, 9]),
        valid=torch.ones(2, dtype=torch.bool),
        **unlabelled(2),
    )
    lanes = [world([[-20.0, -4.0], [40.0, -4.0], [40.0, 12.0], [-20.0, 12.0]])]
    route = world([[0.0, 0.0], [30.0, 0.0]])
    above = draw_from_above(lanes, route, T_WORLD_EGO, boxes, sent=boxes[boxes.track_id == 9])
    assert pixel(above, 16.5, 0.0) == palette.rgb255(palette.box_colour(Category.CAR))
    assert pixel(above, 16.5, 8.0) == palette.rgb255(palette.SCENARIO)
    assert pixel(above, 25.0, 10.0) != palette.rgb255(palette.GROUND)
    assert pixel(above, 25.0, -10.0) == palette.rgb255(palette.GROUND)
