"""The towns' maps against CARLA's own, of the same OpenDRIVE files."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from benchmarks.town_maps import ClientMap, compare_town, lane_differences
from foredrive.towns.map.loading import load_town_map


def test_a_town_on_hills_agrees_with_carla_metre_by_metre(carla: Any) -> None:
    figures = compare_town("Town07", 0)
    for figure in ("lane_max_m", "road_height_max_m", "width_max_m"):
        assert figures[figure] < 0.05, figure
    assert figures["height_p95_m"] < 0.05  # junctions are brought to one height
    assert figures["heading_p95_deg"] < 0.5
    assert figures["lane_changes_equal_pct"] == figures["lights_equal_pct"] == 100.0
    # One more: a lane that opens leaves the lane beside
    assert figures["links_equal_pct"] == pytest.approx(100.0 * 360 / 361)


def test_a_road_that_lies_elsewhere_is_found(carla: Any) -> None:
    client = ClientMap.read("Town02")
    strips = {strip.id: strip for strip in load_town_map("Town02").strips}
    strip = strips[load_town_map("Town02").lanes[0].lane_id]
    aside = dataclasses.replace(strip, left_xyz=strip.left_xyz + np.array([0.3, 0.4, 0.2]))
    found = lane_differences(aside, client)
    assert found["lane"].max() == pytest.approx(0.25, abs=0.01)
    assert found["height"].max() == pytest.approx(0.1, abs=0.01)
    turned = dataclasses.replace(strip, left_xyz=strip.right_xyz[::-1], right_xyz=strip.left_xyz[::-1])
    assert lane_differences(turned, client)["heading"].min() > 170.0
