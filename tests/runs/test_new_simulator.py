"""A simulator is added as CONTRIBUTING says: a `DriveSource` over a `scene.Simulator`."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float64

from foredrive.data import find_logs
from foredrive.data.logs import Log
from foredrive.driving.dynamics import STEP_S, step
from foredrive.driving.observation import FRAME_STEPS, KeyFrame, no_images
from foredrive.driving.route_progress import RouteLine, RouteProgress
from foredrive.errors import InputError
from foredrive.runs.drive.agent_inputs import inputs_of
from foredrive.runs.drive.agents import make_agent
from foredrive.runs.drive.drive_setup import DriveSetup
from foredrive.runs.drive.suite import DriveJob, DriveSource, DriveSuite, drive_suite
from foredrive.scene import BicycleState, Clip, Control, DriveProgress, Simulator, Step
from foredrive.scene.actors import boxes_in_ego_frame
from foredrive.towns.driving.drive_log import drive_log, log_frame
from foredrive.view.drive_report import write_drive_report

LIMIT_S = 12.0
Route = Float64[np.ndarray, "M 3"]


class EmptyPlane:
    """A flat world without actors, lanes and sensors; its scenario is the route."""

    def reset(self, scenario: Route) -> Clip:
        self._route, self._progress, self._index = RouteLine(scenario), RouteProgress(), 0
        self._ego, self._driven_m = BicycleState(*scenario[0, :2].tolist(), 0.0, 0.0), 0.0
        return self._observed()

    def step(self, control: Control) -> Step:
        moved, self._index = step(self._ego, control), self._index + 1
        self._driven_m += float(np.hypot(moved.x_m - self._ego.x_m, moved.y_m - self._ego.y_m))
        self._ego = moved
        xy = np.array([moved.x_m, moved.y_m])
        self._progress = self._route.advance(self._progress, xy, moved.speed_mps, self.t_s)
        ended = self._route.end_of(self._progress, self.t_s, LIMIT_S)
        events = [] if ended is None else [self._route.end_event(ended, self._progress, moved, self.t_s)]
        clip = self._clip if self._index % FRAME_STEPS else self._observed()
        return Step(clip, events, ended is not None)

    def ego(self) -> BicycleState:
        return self._ego

    def progress(self) -> DriveProgress:
        return DriveProgress(self._route.completion(self._progress), 0.0, self._driven_m)

    @property
    def t_s(self) -> float:
        return self._index * STEP_S

    def _observed(self) -> Clip:
        T = np.eye(4)
        cos, sin = np.cos(self._ego.yaw_rad), np.sin(self._ego.yaw_rad)
        T[:2, :2], T[:2, 3] = [[cos, -sin], [sin, cos]], (self._ego.x_m, self._ego.y_m)
        nobody = boxes_in_ego_frame([], T)
        self.frame = KeyFrame(self.t_s, T, self._ego.speed_mps, no_images(), None, nobody)
        self._clip = self._route.observe([self.frame], self._progress, None)
        return self._clip


@dataclass(frozen=True)
class StraightRoutes:
    """A `DriveSource` of straight routes on the plane."""

    lengths_m: tuple[int, ...]
    in_turn = True
    grows = ()

    def noted(self) -> Mapping[str, object]:
        return {**dataclasses.asdict(self), "routes": "straight"}

    def jobs(self, agent: str) -> Sequence[DriveJob]:
        inputs_of(agent)
        return [DriveJob(f"of_{length}_m", str(length)) for length in self.lengths_m]

    @contextlib.contextmanager
    def set_up(self, job: DriveJob, suite: DriveSuite, out: Path) -> Iterator[DriveSetup]:
        simulator, route = EmptyPlane(), np.array([[0.0, 0, 0], [float(job.route), 0, 0]])
        agent = make_agent(suite.agent, lambda: simulator.t_s)
        with drive_log(out, job.name, route, None) as log:
            yield DriveSetup(
                simulator,
                route,
                agent,
                route,
                float(job.route),
                log,
                lambda: log_frame(simulator.frame, simulator.ego(), None),
            )


def test_a_new_simulator_is_driven_scored_logged_and_reported(tmp_path: Path) -> None:
    source = StraightRoutes((20, 200))
    assert isinstance(source, DriveSource)
    assert isinstance(EmptyPlane(), Simulator)
    suite = DriveSuite("constant-velocity", source)
    near, far = drive_suite(suite, tmp_path).drives.values()
    assert (near.score.ending, near.driving_score_1_0) == ("completed", 100.0)
    assert far.score.ending == "timeout"
    assert far.score.duration_s == pytest.approx(LIMIT_S)
    assert 200 * far.score.completion == pytest.approx(far.score.driven_m, abs=1.0)
    logs = {path.folder.name: Log(path) for path in find_logs(tmp_path)}
    assert logs["of_200_m"].T_world_ego[-1, 0, 3] == pytest.approx(far.score.driven_m, abs=3.0)
    assert drive_suite(suite, tmp_path).skipped == 2
    assert "constant-velocity on straight" in write_drive_report(tmp_path).read_text()
    with pytest.raises(InputError, match="another suite"):
        drive_suite(DriveSuite("constant-velocity", StraightRoutes((20,))), tmp_path)
