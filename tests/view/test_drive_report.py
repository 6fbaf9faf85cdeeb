"""The report on a folder of drives, of names that come from outside."""

import json
from pathlib import Path
from urllib.parse import quote

from html_pages import EVIL, Page, assert_harmless

from foredrive.engine.summary import write_summary
from foredrive.runs.drive.records import read_drive, summarise
from foredrive.view.drive_report import score_table, write_drive_report


def make_drive(name: str) -> dict[str, object]:
    """A drive as it lies on disk: 10 m in 2 s, a scenario, and an infraction that ends it."""
    infraction = {"kind": "collision_static", "t_s": 1.5, "xy_world": [5.0, 0.0], "severity": 2.0}
    infraction |= {"what": name, "detail": name}
    return {
        "town": None,
        "length_m": 10.0,
        "score": {
            "route": name,
            "repetition": 0,
            "completion": 1.0,
            "outside_lanes": 0.25,
            "ending": "completed",
            "infractions": [infraction],
            "driven_m": 10.0,
            "duration_s": 2.0,
        },
        "driving_score_1_0": 48.75,
        "driving_score_2_1": 40.0,
        "error": name,
        "events": [{"kind": "scenario", "t_s": 1.0, "xy_world": [2.0, 0.0], "detail": name, "what": name}],
        "comfort": None,
        "nearest_s": [None, 0.5],
        "act_s": [0.01],
        "route_xy": [[0.0, 0.0], [10.0, 0.0]],
        "track": {"t_s": [0.0, 2.0], "xy": [[0.0, 0.0], [10.0, 0.0]], "yaw_rad": [0, 0], "speed_mps": [5, 5]},
        "wall_s": 1.0,
        "log": "logs/town_test/one",
    }


def write_suite(folder: Path, name: str) -> Path:
    """A folder of one drive, with a film that is there already."""
    for part in ("drives", "videos"):
        (folder / part).mkdir()
    path = folder / "drives" / f"{name}.json"
    path.write_text(json.dumps(make_drive(name)))
    (folder / "videos" / f"{name}.webp").touch()
    (folder / "suite.json").write_text(json.dumps({"agent": name, "routes": f"{name}.xml"}))
    write_summary(folder / "summary.json", summarise([read_drive(path)]) | {"command": name})
    return write_drive_report(folder)


def test_names_from_outside_run_nothing(tmp_path: Path) -> None:
    html = write_suite(tmp_path, EVIL).read_text()
    # title and heading (agent and routes), command, table, and of the drive: heading, error, what, scenario
    assert_harmless(html, times=4 + 1 + 1 + 4)
    images = [attributes["src"] for tag, attributes in Page(html).tags if tag == "img"]
    assert images == [f"videos/{quote(EVIL)}.webp"]
    links = [attributes["href"] for tag, attributes in Page(html).tags if tag == "a"]
    anchors = [attributes.get("id") for tag, attributes in Page(html).tags if tag == "h3"]
    assert links == [f"#{anchor}" for anchor in anchors]


def test_a_drive_is_told_in_the_order_of_events(tmp_path: Path) -> None:
    text = " ".join(Page(write_suite(tmp_path, "one").read_text()).text.split())
    assert "one: 48.8, completed" in text
    assert text.index("1.0 s: scenario 1 one") < text.index("1.5 s: collision static one")
    assert "1 collision static" not in text  # it is in the table of infractions instead
    assert "Endings: 1 completed." in text
    assert "25.0" in text  # of the way was outside of lanes


def test_the_terminal_shows_scores_infractions_and_failures(tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    path.write_text(json.dumps(make_drive("one") | {"error": ""}))
    table = score_table(summarise([read_drive(path)]))
    rows = {str(row.cells[0]): row.cells[1] for section in table.sections for row in section.rows}
    assert table.title == "1 route, 1 repetition"
    assert rows["collision static"] == "1  (100.00 / km)"
    assert rows["Failed drives"] == 0
    assert rows["Planning time, median, ms"] == "10"
