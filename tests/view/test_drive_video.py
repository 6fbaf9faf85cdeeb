"""The scene from above in the film of a drive."""

import math

import numpy as np

from foredrive.scene.traffic_light import LightState
from foredrive.view import palette
from foredrive.view.drive_video import ABOVE_WH, EGO_AT_X, LIGHT_COLOURS, PX_PER_M, draw_from_above


def test_a_stop_line_lies_across_the_road_ahead_in_the_colour_of_its_light() -> None:
    yaw = math.radians(120.0)
    R = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    T_world_ego = np.eye(4)
    T_world_ego[:2, :2], T_world_ego[:2, 3] = R, (40.0, -7.0)
    ends = np.array([[20.0, 2.0], [20.0, -2.0]]) @ R.T + T_world_ego[:2, 3]  # 20 m ahead
    route = np.array([[0.0, 0.0], [30.0, 0.0]]) @ R.T + T_world_ego[:2, 3]
    above = draw_from_above(None, route, T_world_ego, None, [(LightState.RED, ends)])

    def pixel(x_m: float, y_m: float) -> tuple[int, ...]:
        x, y = EGO_AT_X * ABOVE_WH[0] + PX_PER_M * x_m, 0.5 * ABOVE_WH[1] - PX_PER_M * y_m
        colour = above.getpixel((round(x), round(y)))
        assert isinstance(colour, tuple)
        return colour

    red = palette.rgb255(LIGHT_COLOURS[LightState.RED])
    assert np.abs(np.subtract(pixel(20.0, 1.0), red)).max() < 90
    assert np.abs(np.subtract(pixel(20.0, -1.0), red)).max() < 90
    for x_m, y_m in ((20.0, 4.0), (17.0, 1.0), (-20.0, 1.0)):
        assert pixel(x_m, y_m) == palette.rgb255(palette.GROUND)
