"""The towns' maps against CARLA's own, of the same OpenDRIVE files."""

import dataclasses
from pathlib import Path
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


SHAPES = {
    "line": "<line/>",
    "arc": '<arc curvature="-0.03"/>',
    "spiral": '<spiral curvStart="0" curvEnd="0.04"/>',
    "cubic": '<paramPoly3 aU="0" bU="60" cU="0" dU="0" aV="0" bV="0" cV="12" dV="-5" pRange="normalized"/>',
}

LENGTH_M = 60.472524
"""Length of the cubic, and of the other roads."""


@pytest.mark.parametrize("shape", SHAPES)
def test_a_road_of_ones_own_lies_where_carla_puts_it(shape: str, carla: Any, tmp_path: Path) -> None:
    text = f"""<OpenDRIVE><header revMajor="1" revMinor="6"/><road id="4" length="{LENGTH_M}" junction="-1">
    <planView><geometry s="0" x="20" y="-30" hdg="0.8" length="{LENGTH_M}">
    {SHAPES[shape]}</geometry></planView>
    <elevationProfile><elevation s="0" a="2" b="0.05" c="0.001" d="0"/></elevationProfile>
    <lanes><laneOffset s="0" a="1" b="0" c="0" d="0"/><laneSection s="0">
    <center><lane id="0" type="none"/></center>
    <right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0.01" c="0" d="0"/></lane></right>
    </laneSection></lanes></road></OpenDRIVE>"""
    path = tmp_path / "own.xodr"
    path.write_text(text)
    town = load_town_map(str(path))
    found = lane_differences(town.strips[0], ClientMap.of("own", text))
    assert found["lane"].max() < 3e-3
    assert found["height"].max() < 1e-3
    assert found["width"].max() < 1e-3
    assert found["heading"].max() < 0.5
