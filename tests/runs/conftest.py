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
    """Two short routes of Town02."""
    from builders import routes_along

    return routes_along(tmp_path_factory.mktemp("routes") / "two.xml", "Town02")
