"""Routes and a reconstructed log for tests that drive."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def reconstructed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small log that was reconstructed, in `run` beside the log."""
    from builders import reconstructed_log

    return reconstructed_log(tmp_path_factory.mktemp("tested_in"), frames=67).folder


@pytest.fixture(scope="session")
def scenarios(reconstructed: Path) -> Path:
    """A car stands on the logged path 5 s on, and in a second scenario far beside it."""
    from foredrive.driving.ncap.scenario import Jitter, Polyline, SafetyScenario, ScenarioActor
    from foredrive.driving.ncap.scenario_file import save_scenarios
    from foredrive.driving.replay.threats import Threat
    from foredrive.runs.drive.in_reconstruction import opened_reconstruction

    vehicle = opened_reconstruction(str(reconstructed)).vehicle
    spot = vehicle.T_world_scene @ vehicle.at(5.0).T_scene_ego.double()
    x, y, z = spot[:3, 3].tolist()
    car = str(opened_reconstruction(str(reconstructed)).scene.graph.tracks.track_id.tolist()[0])
    found = []
    for name, aside_m in (("on", 0.0), ("beside", 30.0)):
        point = (x - aside_m * float(spot[1, 0]), y + aside_m * float(spot[0, 0]), z)
        actor = ScenarioActor((car,), Polyline((0.0, 9.0), (point, point)), jitter=Jitter(lateral_m=0.3))
        found.append(SafetyScenario(name, Threat.STATIONARY, "run", 1, 6.0, (actor,), 1))
    save_scenarios(found, reconstructed.parent / "scenarios.yaml")
    return reconstructed.parent / "scenarios.yaml"


@pytest.fixture(scope="session")
def routes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short routes of Town02 in CARLA's form, along one lane; CARLA's y points to the right."""
    import numpy as np

    from foredrive.towns.map.town_map import load_town_map
    from foredrive.towns.traffic.lane_graph import build_lane_graph

    graph = build_lane_graph(load_town_map("Town02"))
    lane = int(np.argmax(np.where(graph.contested, 0.0, graph.length_m)))
    text = ""
    for name, first_m in (("a", 20.0), ("b", 60.0)):
        ends = graph.position(np.full(2, lane), np.array([first_m, first_m + 14.0]))
        points = "".join(f'<waypoint x="{x}" y="{-y}" z="{z}"/>' for x, y, z in ends)
        text += f'<route id="{name}" town="Town02">{points}</route>'
    path = tmp_path_factory.mktemp("routes") / "two.xml"
    path.write_text(f"<routes>{text}</routes>")
    return path
