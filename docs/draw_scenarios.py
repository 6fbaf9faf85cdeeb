"""Draws the picture of scenarios in docs/towns.md: `python docs/draw_scenarios.py`. Takes some minutes."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from draw_towns import sheet
from PIL import Image

from foredrive.simulation.drive import drive_route
from foredrive.simulation.route_sets import load_route_set
from foredrive.simulation.routes import DriveRoute, snap_route
from foredrive.simulation.scenarios.kinds import Scenario, ScenarioKind
from foredrive.simulation.scenarios.places import possible_scenarios
from foredrive.simulation.town import TownScenario, TownSimulator, TownState, grow
from foredrive.simulation.town_expert import TownExpert
from foredrive.towns.sensing.capture import SensorSuite
from foredrive.towns.sensing.rig import camera_rig, roof_lidar
from foredrive.view.drive_video import from_above

HERE = Path(__file__).parent
SEED = 3
CAMERA_HW = (180, 320)
ABOVE_HW = (130, 320)
SHOWN_AFTER_S = {
    ScenarioKind.LEAD_BRAKES: 1.0,
    ScenarioKind.OBSTACLE_BEHIND_CORNER: 2.5,
    ScenarioKind.CROSSING_PEDESTRIAN: 2.0,
    ScenarioKind.CROSSING_CYCLIST: 2.0,
    ScenarioKind.ONCOMING_TRAFFIC: 2.0,
    ScenarioKind.RED_LIGHT_RUNNER: 3.5,
    ScenarioKind.CUT_IN: 2.5,
    ScenarioKind.DOOR_ZONE: 2.0,
}
"""How long after it has begun each is to be seen best."""


def places(kind: ScenarioKind) -> Iterator[tuple[DriveRoute, Scenario]]:
    """Where on short routes it can happen."""
    for given in (*load_route_set("town05-short"), *load_route_set("training-short")):
        route = snap_route(given)
        world = grow(route.town, SEED)
        for scenario in possible_scenarios(route, world, np.random.default_rng(0)):
            if scenario.kind is kind:
                yield route, scenario
                break


def play(simulator: TownSimulator, kind: ScenarioKind) -> tuple[DriveRoute, list[TownState]]:
    """The expert's drive over the first place where it happens: a state for each key frame from then on."""
    for route, scenario in places(kind):
        states: list[TownState] = []
        drive_route(
            simulator,
            TownScenario(route.town, route.xyz, SEED, route.lanes, scenarios=(scenario,), limit_s=90.0),
            TownExpert(simulator),
            route=route.id,
            on_frame=lambda kept=states: kept.append(simulator.state),
        )
        after = [state for state in states if state.play.begun]
        if after:
            return route, after
    raise AssertionError(f"{kind} happens nowhere")


def picture(simulator: TownSimulator, route: DriveRoute, state: TownState) -> Image.Image:
    """What the front camera sees, and below the scene from above."""
    frame, world = state.frames[-1], grow(route.town, SEED)
    rig = camera_rig(CAMERA_HW)
    sensors = SensorSuite(rig, roof_lidar(channels=1, azimuth_steps=8))
    lights = simulator.traffic.zone_lights(state.decided.time_s)
    actors = simulator.traffic.actors(state.decided)
    seen = world.render(actors, sensors, frame.T_world_ego, np.zeros(6), 0, lights)
    page = Image.new("RGB", (CAMERA_HW[1], CAMERA_HW[0] + ABOVE_HW[0]))
    page.paste(Image.fromarray(seen.images["PCAM_F0"]), (0, 0))
    above = from_above(route.town, route.xyz[:, :2], frame.T_world_ego, frame.boxes)
    top = (above.height - ABOVE_HW[0] * 3 // 2) // 2
    cut = above.crop((60, top, 60 + ABOVE_HW[1] * 3 // 2, top + ABOVE_HW[0] * 3 // 2))
    page.paste(cut.resize(ABOVE_HW[::-1], Image.Resampling.LANCZOS), (0, CAMERA_HW[0]))
    return page


def main() -> None:
    """Each kind at one moment: from the vehicle, and from above."""
    simulator, cells = TownSimulator(), []
    for kind, after_s in SHOWN_AFTER_S.items():
        route, states = play(simulator, kind)
        shown_s = states[0].play.begun[0][1] + after_s
        state = min(states, key=lambda s: abs(s.t_s - shown_s))
        cells.append((kind.value.replace("_", " "), np.asarray(picture(simulator, route, state))))
    sheet(cells, 4).save(HERE / "towns_scenarios.jpg", quality=82)


if __name__ == "__main__":
    main()
