"""Simulator over a reconstructed log: the ego vehicle drives, actors replay, sensors are rendered."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64

from foredrive.driving.collisions import Contacts, EgoContact, blocked, collide, ego_box
from foredrive.driving.dynamics import STEP_S, step, yaw_rate_radps
from foredrive.driving.observation import FRAME_DT_S, FRAME_STEPS, KeyFrame, no_images
from foredrive.driving.replay.logged_drive import LoggedDrive
from foredrive.driving.replay.logged_lanes import LoggedLanes
from foredrive.driving.replay.replayed import comes_from_behind, users_at
from foredrive.driving.route_progress import ARRIVED_M, RouteLine, RouteProgress
from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.methods.reconstruction.tracks import ActorTracks, boxes_at
from foredrive.scene import BicycleState, Clip, Control, DriveProgress, Event, Renderer, Step
from foredrive.scene.actors import BOX_RANGE_M

REACH_M = 6.0
"""Maximum distance from the logged path, m. Further away, sensors would mostly show unobserved space, so
the drive ends."""
MIN_WAY_M = 1.0
"""Shortest way of which a share can be driven, m."""
COLLISION = "collision"
"""Kind of the event in which the first collision ends a drive."""
UNTRUSTED = "untrusted"
"""Kind of the event in which a drive ends because its images are no longer trusted."""
STRUCK = "struck"
"""Kind of the event in which a replayed actor hits the ego vehicle from behind. The actor replays
its track and cannot brake, so this is no collision of the ego vehicle."""


@dataclass(frozen=True, eq=False)
class ReconstructedScenario:
    """Start of a drive. Initial speed and steering are those of the log at that time."""

    start_s: float
    """Start time since the log's first moment, s."""
    sensors: bool = True
    """If False, key frames have only boxes."""
    past_frames: int = 1
    """Number of key frames before now in an observation. They are rendered along the logged path."""
    ends_on_collision: bool = False
    """Whether the first collision of the ego vehicle ends the drive, as in a safety test."""
    length_s: float | None = None
    """Time after which the drive ends, s. The way of the log in this time is the route to complete. None: the
    drive may last to the log's end."""
    contact: EgoContact = field(default_factory=EgoContact)
    """What counts as a collision."""
    stays_trusted: bool = False
    """If True, the drive ends at the first key frame after its start that is not trusted."""


@dataclass(frozen=True, eq=False)
class ReconstructedState:
    """State of a drive at one time. Together with the scenario it determines the future of the drive."""

    step_index: int
    ego: BicycleState
    frames: tuple[KeyFrame, ...]
    contacts: Contacts = field(default_factory=Contacts)
    progress: RouteProgress = field(default_factory=RouteProgress)
    driven_m: float = 0.0
    outside_m: float = 0.0
    """Part of `driven_m` outside of all lanes, m."""
    trusted: tuple[bool, ...] = ()
    """True for each key frame since the start that the renderer trusts. Empty if it does not say."""
    ended: str | None = None
    """Reason why the drive is over. None while it goes on."""

    @property
    def t_s(self) -> float:
        """Return the time since the drive began, s."""
        return self.step_index * STEP_S


class ReconstructedSimulator:
    """A `Simulator` over a reconstructed log: equal scenarios and controls give equal drives.

    Actors replay their tracks and do not react. Static objects without a box are no obstacles.

    Args:
        renderer: renderer of the scene.
        tracks: tracks of the scene's actors, including edits, in the scene frame.
        drive: logged drive of the ego vehicle.
        lanes: lanes of the log's map. Without them, departures from the lanes are not detected.
    """

    state: ReconstructedState

    def __init__(
        self, renderer: Renderer, tracks: ActorTracks, drive: LoggedDrive, lanes: LoggedLanes | None = None
    ) -> None:
        self.renderer, self.drive, self._lanes = renderer, drive, lanes
        self._tracks = tracks.map_tensors(lambda tensor: tensor.detach().cpu())
        self._T_world_scene = drive.vehicle.T_world_scene

    def reset(self, scenario: ReconstructedScenario) -> Clip:
        """Start a drive.

        Raises:
            InputError: the log does not cover the past frames before the start and some distance after it.
        """
        self.drive.check_start(scenario.start_s, scenario.past_frames * FRAME_DT_S)
        self._scenario = scenario
        self._route = RouteLine(self.drive.route_from(scenario.start_s))
        self._way_m = self.way_m(scenario)
        frames: tuple[KeyFrame, ...] = ()
        # Key frames before the start are rendered along the log
        for number in range(-scenario.past_frames, 1):
            t_s = number * FRAME_DT_S
            at_s = scenario.start_s + t_s
            frames = self._with_frame(frames, self.drive.state_at(at_s), self.drive.pose_at(at_s), t_s)
        self.state = _judged(ReconstructedState(0, self.drive.state_at(scenario.start_s), frames))
        self._clip = self._make_clip()
        return self._clip

    def step(self, control: Control) -> Step:
        """Drive on for `STEP_S`. The clip is that of the latest key frame.

        Raises:
            InputError: the drive is over, or the control is not finite.
        """
        return self.step_to(step(self.state.ego, control))

    def step_to(self, moved: BicycleState) -> Step:
        """Drive on for `STEP_S` to the state that another model of the vehicle has found.

        Raises:
            InputError: the drive is over.
        """
        state = self.state
        if state.ended is not None:
            raise InputError(f"the drive is over ({state.ended}): reset the simulator")
        state, events = self._drive(state, moved)
        self.state = state
        if state.step_index % FRAME_STEPS == 0:
            T = self.drive.on_ground(state.ego)
            frames = self._with_frame(state.frames, state.ego, T, state.t_s)
            state = _judged(dataclasses.replace(state, frames=frames))
            if self._scenario.stays_trusted and state.ended is None and state.trusted[-1:] == (False,):
                state = dataclasses.replace(state, ended=UNTRUSTED)
                events.append(self._route.end_event(UNTRUSTED, state.progress, state.ego, state.t_s))
            self.state = state
            self._clip = self._make_clip()
        return Step(self._clip, events, state.ended is not None)

    def ego(self) -> BicycleState:
        """Return the current state of the ego vehicle."""
        return self.state.ego

    def progress(self) -> DriveProgress:
        """Return the progress of the drive. Without lanes the distance outside of them is 0."""
        state = self.state
        outside = state.outside_m / state.driven_m if state.driven_m > 0 else 0.0
        completion = self._route.completion(state.progress)
        if self._scenario.length_s is not None:
            completion = min(1.0, state.progress.done_m / self._way_m)
        return DriveProgress(completion, outside, state.driven_m)

    def way_m(self, scenario: ReconstructedScenario) -> float:
        """Return the distance to drive in a scenario, m: that of the log in the scenario's time.

        Raises:
            InputError: the log stands in this time.
        """
        left_m = self.drive.way_left_m(scenario.start_s)
        if scenario.length_s is None:
            return left_m
        # Way of the log within the test's time
        way_m = left_m - self.drive.way_left_m(min(scenario.start_s + scenario.length_s, self.drive.end_s))
        if way_m < MIN_WAY_M:
            raise InputError(
                f"from {scenario.start_s:g} s on, the log drives {way_m:.1f} m in {scenario.length_s:g} s"
            )
        return way_m

    @property
    def tracks(self) -> ActorTracks:
        """Return the tracks of the actors, those of a test included."""
        return self._tracks

    @property
    def scenario(self) -> ReconstructedScenario:
        """Return the current scenario."""
        return self._scenario

    @property
    def length_m(self) -> float:
        """Return the length of the route, m."""
        return self._route.length_m

    def _drive(
        self, state: ReconstructedState, moved: BicycleState
    ) -> tuple[ReconstructedState, list[Event]]:
        """Move the ego vehicle unless an obstacle stops it. Return the new state and the events."""
        index = state.step_index + 1
        t_s = index * STEP_S
        contact = self._scenario.contact
        users = users_at(self._tracks, self._T_world_scene, self._scenario.start_s + t_s)
        users = contact.counted(users)
        # Actors behind the ego vehicle that touch it have hit it; they are reported but do not count
        box = ego_box(self.drive.on_ground(moved), moved, contact.vehicle)
        behind = comes_from_behind(box, users) & (not contact.struck_counts)
        before = users.without(users.track_id[behind])
        events, contact_users = collide(box, moved, before, state.contacts.users, t_s)
        struck, contact_users = collide(
            box, moved, users.without(users.track_id[~behind]), contact_users, t_s
        )
        # An obstacle in front stops the vehicle where it was
        if blocked(box, before):
            moved = dataclasses.replace(state.ego, speed_mps=0.0, acceleration_mps2=0.0)
        xy = np.array([moved.x_m, moved.y_m])
        # Progress and ending by the pose after a possible stop
        progress = self._route.advance(state.progress, xy, moved.speed_mps, t_s)
        ended = COLLISION if events and self._scenario.ends_on_collision else self._end_of(progress, t_s)
        events += [dataclasses.replace(event, kind=STRUCK) for event in struck]
        if ended is not None:
            events.append(self._route.end_event(ended, progress, moved, t_s))
        way_m = float(np.hypot(moved.x_m - state.ego.x_m, moved.y_m - state.ego.y_m))
        outside = self._lanes is not None and self._lanes.outside(box.foot_m[:2])
        return dataclasses.replace(
            state,
            step_index=index,
            ego=moved,
            contacts=Contacts(contact_users),
            progress=progress,
            driven_m=state.driven_m + way_m,
            outside_m=state.outside_m + way_m * outside,
            ended=ended,
        ), events

    def _end_of(self, progress: RouteProgress, t_s: float) -> str | None:
        """Return the reason why the drive is over, or None.

        A drive also ends when it leaves the part of space or time that the log covers.
        """
        left_s = self.drive.end_s - self._scenario.start_s
        length_s = left_s if self._scenario.length_s is None else min(left_s, self._scenario.length_s)
        ended = self._route.end_of(progress, t_s, length_s - 0.5 * STEP_S)
        # At the end of the time, almost all of the way counts as completed
        left_m = self._way_m - progress.done_m
        if ended == "timeout" and left_m < min(ARRIVED_M, 0.5 * self._way_m):
            return "completed"
        return "deviation" if ended is None and progress.beside_m > REACH_M else ended

    def _with_frame(
        self, frames: tuple[KeyFrame, ...], ego: BicycleState, T: Float64[np.ndarray, "4 4"], t_s: float
    ) -> tuple[KeyFrame, ...]:
        """Append a new key frame and return the latest frames, as many as an observation has."""
        at_s = self._scenario.start_s + t_s
        images, sweep, trusted = no_images(), None, None
        T_world_ego = torch.from_numpy(T)
        if self._scenario.sensors:
            twist = torch.tensor([ego.speed_mps, 0.0, 0.0, 0.0, 0.0, yaw_rate_radps(ego)])
            seen = self.renderer.render(T_world_ego, twist, at_s)
            images, sweep, trusted = seen.images, seen.sweep, seen.trusted
        boxes = boxes_at(self._tracks, inverse_se3(self._T_world_scene) @ T_world_ego, at_s, BOX_RANGE_M)
        frame = KeyFrame(t_s, T, ego.speed_mps, images, sweep, boxes, trusted)
        return (*frames, frame)[-1 - self._scenario.past_frames :]

    @property
    def trusted_share(self) -> float | None:
        """Return the share of the drive's key frames that are trusted. None if the renderer does not say."""
        trusted = self.state.trusted
        return sum(trusted) / len(trusted) if trusted else None

    def _make_clip(self) -> Clip:
        rig = self.renderer.rig if self._scenario.sensors else None
        return self._route.observe(self.state.frames, self.state.progress, rig)


def _judged(state: ReconstructedState) -> ReconstructedState:
    """Note whether the latest key frame is trusted."""
    latest = state.frames[-1].trusted
    return state if latest is None else dataclasses.replace(state, trusted=(*state.trusted, latest))
