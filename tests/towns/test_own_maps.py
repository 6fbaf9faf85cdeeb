"""Road maps of one's own."""

import math
from pathlib import Path

import numpy as np
import pytest

from foredrive.cli.main import main
from foredrive.data import find_logs
from foredrive.data.logs import Log
from foredrive.data.maps import map_file
from foredrive.errors import InputError
from foredrive.scene.conditions import BackgroundTraffic
from foredrive.sensors.rigs import FRONT_TELE, camera_rig
from foredrive.towns.map.loading import load_town_map
from foredrive.towns.map.names import map_name
from foredrive.towns.map.town_map import StripKind
from foredrive.towns.recorder import record
from foredrive.towns.sensing.capture import SensorSuite

LANES = """<right>
<lane id="-1" type="driving"><link><predecessor id="-1"/><successor id="-1"/></link>
<width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
<lane id="-2" type="sidewalk"><link><predecessor id="-2"/><successor id="-2"/></link>
<width sOffset="0" a="2" b="0" c="0" d="0"/></lane></right>"""
TOWN_LIMIT = '<type s="0" type="town"><speed {}/></type>'


def road(
    number: int, shape: str, start: tuple[float, ...], length: float, links: str, limit: str = ""
) -> str:
    """Return a road with as little as OpenDRIVE asks for."""
    x, y, yaw = start
    kind = TOWN_LIMIT.format(limit) if limit else ""
    return f"""<road name="" length="{length!r}" id="{number}" junction="-1"><link>{links}</link>{kind}
    <planView><geometry s="0" x="{x!r}" y="{y!r}" hdg="{yaw!r}" length="{length!r}">{shape}</geometry>
    </planView><lanes><laneSection s="0"><center><lane id="0" type="none"/></center>{LANES}</laneSection>
    </lanes></road>"""


def written(folder: Path, *roads: str) -> str:
    """Return the path of a file with roads."""
    path = folder / "own.xodr"
    path.write_text(f'<OpenDRIVE><header revMajor="1" revMinor="6"/>{"".join(roads)}</OpenDRIVE>')
    return str(path)


def linked(before: int | None, after: int | None) -> str:
    ends = (("predecessor", before, "end"), ("successor", after, "start"))
    return "".join(
        f'<{name} elementType="road" elementId="{number}" contactPoint="{at}"/>'
        for name, number, at in ends
        if number is not None
    )


def oval(folder: Path) -> str:
    """Return a map of two straight roads, joined by half circles."""
    radius_m, straight_m = 40.0, 120.0
    half_m, bend = math.pi * radius_m, f'<arc curvature="{1 / radius_m!r}"/>'
    return written(
        folder,
        road(1, "<line/>", (0.0, 0.0, 0.0), straight_m, linked(4, 2), 'max="10" unit="m/s"'),
        road(2, bend, (straight_m, 0.0, 0.0), half_m, linked(1, 3), 'max="no limit"'),
        road(3, "<line/>", (straight_m, 2 * radius_m, math.pi), straight_m, linked(2, 4)),
        road(4, bend, (0.0, 2 * radius_m, math.pi), half_m, linked(3, 1)),
    )


def test_a_map_is_read_that_leaves_out_what_says_nothing(tmp_path: Path) -> None:
    town = load_town_map(oval(tmp_path))
    lanes = {lane.lane_id: lane for lane in town.lanes}
    ring = [f"{number}_0_right_-1" for number in (1, 2, 3, 4)]
    assert sorted(lanes) == ring
    for name, onward in zip(ring, [*ring[1:], ring[0]], strict=True):
        assert lanes[name].successor_ids == (onward,)
        assert np.linalg.norm(lanes[name].centreline_xyz[-1] - lanes[onward].centreline_xyz[0]) < 0.01
    assert [lanes[name].speed_limit_mps for name in ring] == [pytest.approx(10.0), None, None, None]
    assert len(town.strips_of(StripKind.SIDEWALK)) == 4


def test_a_road_keeps_all_lanes_at_its_open_ends(tmp_path: Path) -> None:
    wide = LANES.replace('id="-2" type="sidewalk"', 'id="-2" type="driving"')
    straight = road(7, "<line/>", (3.0, 4.0, 0.5), 60.0, "").replace(LANES, wide)
    town = load_town_map(written(tmp_path, straight))
    assert {lane.lane_id for lane in town.lanes} == {"7_0_right_-1", "7_0_right_-2"}


def test_a_polynomial_is_followed_by_its_length(tmp_path: Path) -> None:
    """y = x² / 500 over 100 m of x, whose parameter does not grow evenly along the road."""
    x = np.linspace(0.0, 100.0, 100_001)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(x * x / 500)))])
    shape = '<paramPoly3 aU="0" bU="100" cU="0" dU="0" aV="0" bV="0" cV="20" dV="0" pRange="normalized"/>'
    yaw, place = 0.7, np.array([10.0, -20.0])
    town = load_town_map(written(tmp_path, road(3, shape, (10.0, -20.0, yaw), float(along[-1]), "")))
    (lane,) = town.lanes
    # The left border of the only lane is the reference line
    found = (lane.left_boundary_xyz[:, :2] - place) @ [
        [np.cos(yaw), -np.sin(yaw)],
        [np.sin(yaw), np.cos(yaw)],
    ]
    at = np.interp(np.linspace(0.0, along[-1], len(found)), along, x)
    np.testing.assert_allclose(found, np.column_stack([at, at * at / 500]), atol=2e-3)


def test_a_spiral_of_one_curvature_is_an_arc(tmp_path: Path) -> None:
    """py123d refuses it; `carla.Map` of 0.9.16 puts it nowhere."""
    spiral = '<spiral curvStart="0.02" curvEnd="0.02"/>'
    (lane,) = load_town_map(written(tmp_path, road(1, spiral, (0.0, 0.0, 0.0), 100.0, ""))).lanes
    turned = np.linspace(0.0, 2.0, len(lane.centreline_xyz))
    expected = 50.0 * np.column_stack([np.sin(turned), 1 - np.cos(turned)])
    np.testing.assert_allclose(lane.left_boundary_xyz[:, :2], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<OpenDRIVE/>", "no OpenDRIVE file with roads"),
        ("no markup", "syntax error"),
        (road(1, "<line/>", (0.0, 0.0, 0.0), 9.0, "").replace("<road", '<road rule="LHT"'), "on the left"),
        (road(1, '<poly3 a="0" b="0" c="0" d="0"/>', (0.0, 0.0, 0.0), 9.0, ""), "is a poly3"),
        (road(1, "<line/>", (0.0, 0.0, 0.0), 9.0, "").replace('id="1" j', 'id="A" j'), "is no number"),
        (road(1, "<line/>", (0.0, 0.0, 0.0), 9.0, "").replace("driving", "biking"), "no road to drive on"),
        (road(1, "<line/>", (0.0, 0.0, 0.0), 9.0, "").replace("width", "border"), "borders are not read"),
        (road(1, "<line/>", (0.0, 0.0, 0.0), 9.0, "").replace('a="3.5"', ""), "Error parsing road element"),
    ],
)
def test_what_cannot_be_driven_is_refused(text: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "own.xodr"
    path.write_text(f"<OpenDRIVE>{text}</OpenDRIVE>" if text.startswith("<road") else text)
    with pytest.raises(InputError, match=why):
        load_town_map(str(path))
    with pytest.raises(InputError, match="no such file"):
        load_town_map(str(tmp_path / "other.xodr"))


def test_a_drive_through_a_map_of_ones_own_is_a_log_as_any_other(tmp_path: Path) -> None:
    town = oval(tmp_path)
    sensors = SensorSuite(camera_rig(plan=FRONT_TELE.of_size((32, 64))), None)
    record(town, 1.0, 3, tmp_path / "data", 2.0, sensors, BackgroundTraffic(4, 2))
    (path,) = find_logs(tmp_path / "data")
    assert path.folder.name == f"{map_name(town)}_seed3"
    log = Log(path)
    assert len(log.t_us) == 2
    assert map_file(log) is not None
    # A file with other roads is another town
    before = map_name(town)
    other = written(tmp_path, road(1, "<line/>", (0.0, 0.0, 0.0), 30.0, ""))
    assert map_name(other) != before
    assert len(load_town_map(other).lanes) == 1


def test_too_small_a_map_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town = written(tmp_path, road(1, "<line/>", (0.0, 0.0, 0.0), 60.0, ""))
    assert main(["record", "--town", town, "--seconds", "10", "--out", str(tmp_path / "data")]) == 2
    assert "take a larger map" in capsys.readouterr().err


def test_what_is_not_read_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = """<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>
    <signals><signal id="1" s="1" t="0" type="1000001"/></signals>
    <objects><object id="2" type="tree"/></objects></road>"""
    town = written(tmp_path, road(1, "<line/>", (0.0, 0.0, 0.0), 60.0, "").replace("</road>", more))
    assert main(["record", "--town", town, "--out", str(tmp_path / "data")]) == 2  # too small
    assert "not read: 1 tilts of roads, 1 signals outside of junctions, 1 objects" in capsys.readouterr().out
