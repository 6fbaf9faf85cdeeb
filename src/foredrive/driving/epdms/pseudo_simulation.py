"""Two-stage pseudo-simulation (Cao et al., CoRL 2025; NAVSIM v2) in reconstructed logs and in recorded towns.

First stage: the agent plans once from the logged state, and its plan is simulated. Second stage: it plans
once from each of several states beside the logged path, one horizon later. These count by how near they are
to where the first plan ends. Both stages are scored by the EPDMS, at a time and half a second before it,
which the extended comfort compares.

Different from the devkit: agents of this package plan 3 s, so that a stage lasts 3 s and not 4; road users
replay the log, where the devkit's follow IDM; the reference of progress is `ReplayExpert`, not PDM-Closed;
the controller has neuro-ncap's settings of nuPlan's LQR; the vehicle is that of our drives; follow-up states
lie on a fixed grid, where the devkit's come from other planners' drives. There the agent's route keeps the
state's distance to the logged path, while scores look at the lanes. Red lights are not known.
"""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.data.batches import stack_records
from foredrive.driving.dynamics import EGO, yaw_rate_radps
from foredrive.driving.epdms.comfort import extended_comfort
from foredrive.driving.epdms.score import DriverScores, score_plan, two_stage_score
from foredrive.driving.epdms.subscores import progress_m
from foredrive.driving.epdms.world import STEP_S, EgoBody, EgoMotion, Roads, Surroundings
from foredrive.driving.ncap.nuplan_lqr import LqrPlan, lqr_step
from foredrive.driving.ncap.running import Place
from foredrive.driving.observation import FRAME_DT_S
from foredrive.driving.plans import waypoints_of
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.reconstructed import ReconstructedScenario, ReconstructedSimulator
from foredrive.driving.replay.replay_expert import ReplayExpert
from foredrive.driving.replay.replayed import users_at
from foredrive.driving.simple_agents import ReplayAgent
from foredrive.errors import InputError
from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.scene import Agent, BicycleState, Category, Trajectory
from foredrive.scene.boxes import VEHICLES

HORIZON_S, PAST_S = 3.0, 1.5
"""Time for which a plan is simulated, and time before it that comfort looks at, s."""
STEPS = round(HORIZON_S / STEP_S) + 1
MIN_LEFT_M = 10.0
"""Shortest way that the log drives after the second stage begins, m."""
BODY = EgoBody(EGO.length_m, EGO.width_m, EGO.axle_to_centre_m)
MOVES = VEHICLES | {Category.PEDESTRIAN, Category.ANIMAL}


@dataclass(frozen=True)
class Offset:
    """Place of a follow-up state, in the ego frame of the logged pose."""

    ahead_m: float = 0.0
    left_m: float = 0.0
    yaw_rad: float = 0.0


FOLLOW_UPS = tuple(
    Offset(ahead_m, left_m, yaw_rad)
    for ahead_m, left_m, yaw_rad in (
        *((0.0, 0.0, 0.0), (-3.0, 0.0, 0.0), (-6.0, 0.0, 0.0), (3.0, 0.0, 0.0)),
        *((0.0, 0.8, 0.0), (0.0, -0.8, 0.0), (-3.0, 0.8, -0.05), (-3.0, -0.8, 0.05)),
    )
)
"""Follow-up states: on the path, behind and ahead of the log, and beside it."""


@dataclass(frozen=True)
class PseudoScore:
    """Result of one start."""

    start_s: float
    score: float
    """Mean of first times second stage, now and half a second earlier."""
    first: DriverScores
    """Sub-scores of the first stage at the start."""
    second: tuple[DriverScores, ...]
    """Sub-scores of the follow-up states."""
    trusted_share: float | None = None
    """Share of the follow-up states whose images are trusted; None if the renderer does not say."""


@dataclass(frozen=True, eq=False)
class _Planned:
    """A plan that was simulated, and where it ends."""

    ego: EgoMotion
    scores: DriverScores
    start_m: Float64[np.ndarray, "2"]
    end_m: Float64[np.ndarray, "2"]
    trusted_share: float | None


class PseudoSimulation:
    """Pseudo-simulation in one place.

    Args:
        place: a reconstructed log, or a recorded town as `Place`.
        roads: its roads.
        agent_in: returns the agent for a simulator.
        past_frames: number of earlier key frames that the agent observes.
        sensors: whether cameras and lidar are rendered.
        follow_ups: states of the second stage.
    """

    def __init__(
        self,
        place: Place,
        roads: Roads,
        agent_in: Callable[[ReconstructedSimulator], Agent],
        past_frames: int,
        sensors: bool = True,
        follow_ups: tuple[Offset, ...] = FOLLOW_UPS,
    ) -> None:
        self._place, self._roads, self._agent_in = place, roads, agent_in
        self._past_frames, self._sensors, self._follow_ups = past_frames, sensors, follow_ups

    def starts_s(self, every_s: float) -> list[float]:
        """Return the times at which both stages fit into the log and it drives on, every `every_s`."""
        drive = LoggedDrive(self._place.vehicle, torch.eye(4))
        # The first time with enough past frames and enough past for the comfort
        first_s = drive.first_s + max((self._past_frames + 1) * FRAME_DT_S, PAST_S + FRAME_DT_S)
        first_s = FRAME_DT_S * np.ceil(first_s / FRAME_DT_S - 1e-6)
        last_s = drive.end_s - 2 * HORIZON_S
        times = np.arange(first_s, last_s + 1e-6, every_s).tolist()
        return [t_s for t_s in times if drive.way_left_m(t_s + HORIZON_S) > MIN_LEFT_M]

    def score(self, start_s: float) -> PseudoScore:
        """Return the score of one start.

        Raises:
            Exception: any error of the agent: the start has failed, and has no score.
        """
        end = Offset()
        before, now = (self._planned(t_s, end, human=True) for t_s in (start_s - FRAME_DT_S, start_s))
        first = _with_comfort(before, now)
        groups, second = [], []
        later_s = start_s + HORIZON_S
        pairs = [
            # Each follow-up state is planned from twice, half a second apart, for the extended comfort
            _with_comfort(*(self._planned(t_s, offset) for t_s in (later_s - FRAME_DT_S, later_s)))
            for offset in self._follow_ups
        ]
        # Both moments of the first stage are scored with the follow-ups of the same moment
        for moment, planned in enumerate(first):
            follow_ups = [pair[moment] for pair in pairs]
            groups.append(
                two_stage_score(
                    planned.scores.epdms,
                    planned.end_m,
                    np.stack([follow_up.start_m for follow_up in follow_ups]),
                    [follow_up.scores.epdms for follow_up in follow_ups],
                )
            )
            second += [follow_up.scores for follow_up in follow_ups]
        shares = [plan.trusted_share for pair in pairs for plan in pair if plan.trusted_share is not None]
        trusted_share = float(np.mean(shares)) if shares else None
        return PseudoScore(start_s, float(np.mean(groups)), first[1].scores, tuple(second), trusted_share)

    def _planned(self, start_s: float, offset: Offset, human: bool = False) -> _Planned:
        """Return the simulated and scored plan from one state.

        Args:
            human: whether what the log itself does wrong is forgiven.
        """
        # The state beside the log: its pose is the logged one times the offset
        yaw, xyz = torch.tensor(offset.yaw_rad), torch.tensor([offset.ahead_m, offset.left_m, 0.0])
        drive = LoggedDrive(self._place.vehicle, matrix_from_yaw(yaw, xyz))
        graph = self._place.graph
        simulator = ReconstructedSimulator(
            self._place.renderer(graph), graph.all_tracks, drive, self._place.lanes
        )
        clip = simulator.reset(ReconstructedScenario(start_s, self._sensors, self._past_frames))
        state, seen = drive.state_at(start_s), stack_records([clip])
        plan = self._agent_in(simulator).act(seen)
        past, others = past_motion(drive, start_s), self._others(start_s)
        # Reference of progress: the privileged expert from the same state
        reference = self._scored(ReplayExpert(drive).act(seen), state, past, others, 0.0)
        reference_m = reference[1].multiplied * self._progress_m(reference[0])
        ego, scores = self._scored(plan, state, past, others, reference_m)
        # What the log's own driver does wrong is forgiven
        if human:
            logged = ReplayAgent(LoggedDrive(self._place.vehicle, torch.eye(4)), lambda: start_s).act(seen)
            scores = scores.forgiven(self._scored(logged, state, past, others, reference_m)[1])
        # End of the plan in the world frame
        xy = waypoints_of(plan)[-1]
        cos, sin = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
        start_m = np.array([state.x_m, state.y_m])
        end_m = start_m + np.array([cos * xy[0] - sin * xy[1], sin * xy[0] + cos * xy[1]])
        return _Planned(ego, scores, start_m, end_m, simulator.trusted_share)

    def _scored(
        self,
        plan: Trajectory,
        state: BicycleState,
        past: EgoMotion,
        others: Surroundings,
        reference_m: float,
    ) -> tuple[EgoMotion, DriverScores]:
        ego = simulated(plan, state)
        return ego, score_plan(ego, past, others, self._roads, reference_m, BODY)

    def _progress_m(self, ego: EgoMotion) -> float:
        return progress_m(ego, BODY, self._roads)

    def _others(self, start_s: float) -> Surroundings:
        """Return the road users of the log from a time on."""
        tracks, T = self._place.graph.all_tracks, self._place.vehicle.T_world_scene
        moments = [users_at(tracks, T, start_s + STEP_S * step) for step in range(STEPS)]
        return Surroundings(
            centre_m=np.stack([users.foot_m[:, :2] for users in moments]),
            yaw_rad=np.stack([users.yaw for users in moments]),
            half_lw=moments[0].half_lw,
            speed_mps=np.stack([np.hypot(*users.velocity_mps.T) for users in moments]),
            present=np.stack([users.track_id >= 0 for users in moments]),
            moves_by_itself=np.isin(moments[0].category, [int(category) for category in MOVES]),
        )


def _with_comfort(before: _Planned, now: _Planned) -> tuple[_Planned, _Planned]:
    """Return two plans half a second apart with their extended comfort."""
    comfort = extended_comfort(before.ego, now.ego, FRAME_DT_S)
    first, second = (dataclasses.replace(plan.scores, ec=comfort) for plan in (before, now))
    return dataclasses.replace(before, scores=first), dataclasses.replace(now, scores=second)


def simulated(plan: Trajectory, state: BicycleState) -> EgoMotion:
    """Return the vehicle while it follows a plan for `HORIZON_S`.

    Raises:
        InputError: the plan has no finite points, or ends before.
    """
    points = waypoints_of(plan)
    if len(points) * plan.dt_s < HORIZON_S - 1e-6:
        raise InputError(f"a plan of {HORIZON_S:g} s is needed, got {len(points) * plan.dt_s:g} s")
    followed = LqrPlan(state, points, plan.dt_s)
    states = [state]
    for step in range(STEPS - 1):
        states.append(lqr_step(followed, states[-1], STEP_S * step, EGO, 0.0, True))
    return motion_of(states)


def past_motion(drive: LoggedDrive, start_s: float) -> EgoMotion:
    """Return the logged vehicle before a time: 14 states, from 1.5 s to two steps before.

    The devkit leaves out the state one step before, and joins the others to the plan as if it were there.
    """
    times = start_s - STEP_S * np.arange(round(PAST_S / STEP_S), 1, -1)
    return motion_of([drive.state_at(t_s) for t_s in times.tolist()])


def motion_of(states: list[BicycleState]) -> EgoMotion:
    """Return states one step apart as the motion that scores read."""
    return EgoMotion(
        xy_m=np.array([[state.x_m, state.y_m] for state in states]),
        yaw_rad=np.array([state.yaw_rad for state in states]),
        speed_mps=np.array([state.speed_mps for state in states]),
        acceleration_mps2=np.array([state.acceleration_mps2 for state in states]),
        yaw_rate_radps=np.array([yaw_rate_radps(state) for state in states]),
    )


def figures_of(scores: list[PseudoScore], failed: int) -> Mapping[str, float | int | None]:
    """Return the means over all starts. Failed starts are counted and have no share in them."""
    figures: dict[str, float | int | None] = {"starts": len(scores) + failed, "failed": failed}
    figures["epdms"] = float(np.mean([score.score for score in scores])) if scores else None
    shares = [score.trusted_share for score in scores if score.trusted_share is not None]
    figures["second.trusted_share"] = float(np.mean(shares)) if shares else None
    for stage, of in (
        ("first", [score.first for score in scores]),
        ("second", [entry for score in scores for entry in score.second]),
    ):
        for name in ("epdms", *(field.name for field in dataclasses.fields(DriverScores))):
            figures[f"{stage}.{name}"] = (
                float(np.mean([getattr(entry, name) for entry in of])) if of else None
            )
    return figures
