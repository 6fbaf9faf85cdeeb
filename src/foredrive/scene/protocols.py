"""Protocols between the parts of Foredrive, and the types that they exchange."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from foredrive.scene.affordances import PathEstimate
from foredrive.scene.clip import Clip
from foredrive.scene.frames import Frames
from foredrive.scene.record import Record
from foredrive.scene.rig import CameraRig
from foredrive.scene.sweep import LidarSweep
from foredrive.scene.trajectory import Trajectory
from foredrive.scene.voxels import VoxelSpec

Task = Literal["detection", "tracking", "map", "motion", "occupancy", "planning"]
"""Purpose of the features: the six tasks that heads and planners serve."""


@dataclass(frozen=True)
class Belief(Record):
    """State of a world model at one time, in the ego frame of that time."""

    volume: Float[Tensor, "b D Z Y X"]
    state: Float[Tensor, "b S"] | None = None
    """Latent state, for models with one."""
    history: Float[Tensor, "b T D Z Y X"] | None = None
    """Volumes of the past frames, now last, each in its own ego frame. Given if `imagine` needs them."""
    T_past_now: Float[Tensor, "b 4 4"] | None = None
    """The ego frame at now -> that of the last volume before now. Given with a history of at least two."""
    statics: Float[Tensor, "b _C Y X"] | None = None
    """Features of the static scene in the plane, for models that pass them on without warping."""
    T_prev_next: Float[Tensor, "b F 4 4"] | None = None
    """Ego motion over each of the next key frames that poses and speeds suggest: the ego frame at t+k+1
    -> the ego frame at t+k. Given if `imagine` starts from it."""
    flow_mps: Float[Tensor, "b 3 Z Y X"] | None = None
    """Velocity over ground of the content of each voxel, in the ego axes. Given if imagining predicted it."""
    T_now_ego: Float[Tensor, "b 4 4"] | None = None
    """Predicted ego motion: ego frame of this belief -> ego frame at now. None for the belief at now."""


@dataclass(frozen=True)
class Decoded(Record):
    """The decoded output of a belief."""

    occupancy_logit: Float[Tensor, "b Z Y X"]
    feature: Float[Tensor, "b D Z Y X"]
    """Features to composite along rays."""
    flow: Float[Tensor, "b 3 Z Y X"] | None = None
    """Velocity of the content of each voxel, in the ego axes, m/s."""
    action: Float[Tensor, "b A"] | None = None


class RenderedRays(NamedTuple):
    """Colour, range and opacity of R rays through a volume."""

    rgb: Float[Tensor, "b R 3"]
    """RGB, 0 to 1."""
    range_m: Float[Tensor, "b R"]
    """Expected distance of the hit, m. A ray without a hit counts with the far end."""
    alpha: Float[Tensor, "b R"]
    """Probability that the ray ends inside the volume."""


@runtime_checkable
class RayRenderer(Protocol):
    """A renderer of colour and range along rays through a decoded belief."""

    def __call__(
        self,
        feature: Float[Tensor, "b D Z Y X"],
        occupancy_logit: Float[Tensor, "b Z Y X"],
        origin: Float[Tensor, "b R 3"],
        direction: Float[Tensor, "b R 3"],
        generator: torch.Generator | None = None,
    ) -> RenderedRays:
        """Render rays given in the ego frame of the belief. A generator jitters the samples along them."""
        ...


@runtime_checkable
class WorldModel(Protocol):
    """A model that observes the present, imagines the next key frames and decodes both (NeMo, DriveWorld).

    An implementation is also a `torch.nn.Module`. Training changes its parameters.
    """

    @property
    def spec(self) -> VoxelSpec:
        """Return the grid of the volumes."""
        ...

    @property
    def channels(self) -> int:
        """Return D, the number of channels of the volumes."""
        ...

    @property
    def past_frames(self) -> int:
        """Return the number of key frames before now that the model reads."""
        ...

    @property
    def dt_s(self) -> float:
        """Return the time between key frames, s."""
        ...

    @property
    def max_steps(self) -> int | None:
        """Return the maximum number of key frames that the model can imagine. None means no limit."""
        ...

    @property
    def samples_futures(self) -> bool:
        """Return whether `imagine` draws a different future for each state of its generator."""
        ...

    @property
    def renderer(self) -> RayRenderer | None:
        """Return the renderer of decoded beliefs. None if the model cannot be rendered."""
        ...

    def observe(self, clip: Clip) -> Belief:
        """Return the belief about now from the frames up to now.

        Raises:
            InputError: the clip contains the future, or it has too few frames.
        """
        ...

    def encode(self, frames: Frames) -> Belief:
        """Return the belief about now from T = `past_frames` + 1 frames.

        The control flow does not depend on data values, so that the method can be traced for export.
        """
        ...

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K A"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """Return the beliefs of the next `steps` key frames, each in its own predicted ego frame.

        Args:
            actions: input of models that take actions.
            generator: source of randomness for models that sample futures. Without one they return the mean.
        """
        ...

    def decode(self, belief: Belief) -> Decoded:
        """Return occupancy, flow and renderable features of a belief."""
        ...

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume of a belief, at now or imagined, as the head of a task reads it."""
        ...


@runtime_checkable
class Agent(Protocol):
    """A policy that plans the path of the ego vehicle."""

    def act(self, observation: Clip) -> Trajectory:
        """Return the plan from now on, in the ego frame at now."""
        ...


@runtime_checkable
class SeesPath(Protocol):
    """An `Agent` that says what it saw of its path; films of drives show it."""

    @property
    def sight(self) -> PathEstimate | None:
        """Return what its last plan was made from, a batch of one; None before the first plan."""
        ...


@dataclass(frozen=True)
class Control:
    """Control of the vehicle for one simulation step."""

    acceleration_mps2: float
    steering_rad: float
    """Front-wheel angle, positive to the left."""


@dataclass(frozen=True)
class Event:
    """An event that a simulator detected: a collision, a red light run, the end of a route."""

    kind: str
    t_s: float
    xy_world: tuple[float, float]
    detail: str = ""
    what: str = ""
    """Object of the event: the object hit, the light or sign that was run, the lane that was left."""
    severity: float = 0.0
    """For a collision the impact speed, m/s. For leaving the lanes the distance driven outside, m."""


@dataclass(frozen=True)
class Step:
    """Result of one simulation step."""

    clip: Clip
    events: Sequence[Event]
    done: bool


@dataclass(frozen=True)
class BicycleState:
    """The ego vehicle at one time, in the world frame seen from above."""

    x_m: float
    """Middle of the rear axle."""
    y_m: float
    yaw_rad: float
    """In [-π, π]."""
    speed_mps: float
    """Never negative: vehicles do not reverse."""
    steering_rad: float = 0.0
    """Front-wheel angle, positive to the left."""
    acceleration_mps2: float = 0.0
    """Derivative of the speed; 0 while the vehicle stands."""


@dataclass(frozen=True)
class DriveProgress:
    """Progress of a drive."""

    completion: float
    """Share of the route, 0 to 1."""
    outside_lanes: float
    """Share of the way driven outside of the lanes or against them, 0 to 1."""
    driven_m: float


@runtime_checkable
class Simulator(Protocol):
    """A simulated world that reacts to controls: a town, a reconstructed log, CARLA."""

    def reset(self, scenario: Any) -> Clip:
        """Start a drive and return its first key frame."""
        ...

    def step(self, control: Control) -> Step:
        """Drive on for one simulation step. The `kind` of an event gives the reason why a drive ended."""
        ...

    def ego(self) -> BicycleState:
        """Return the current state of the ego vehicle."""
        ...

    def progress(self) -> DriveProgress:
        """Return the progress of the drive."""
        ...


@dataclass(frozen=True)
class Rendered(Record):
    """Images and lidar of a vehicle at one time, unbatched."""

    images: UInt8[Tensor, "C 3 H W"]
    """RGB, in the camera order of the renderer's rig."""
    sweep: LidarSweep | None
    """One revolution in the ego frame, with the beams that do not return. None if there is no lidar."""
    trusted: bool | None = None
    """Whether the frame should be almost as good as those of the log; None: the renderer does not say."""


@runtime_checkable
class Renderer(Protocol):
    """A sensor renderer of a reconstructed log. The vehicle may have any pose in the scene."""

    @property
    def rig(self) -> CameraRig:
        """Return the cameras, without leading dimensions. All are exposed at the requested time."""
        ...

    def render(
        self, T_world_ego: Float64[Tensor, "4 4"], twist_ego: Float[Tensor, "6"], t_s: float
    ) -> Rendered:
        """Render the sensors from a pose at a time of the scene.

        Args:
            T_world_ego: pose of the vehicle.
            twist_ego: velocity (m/s) and turn rate (rad/s) over ground, in the axes of the vehicle.
            t_s: time since the start of the scene.
        """
        ...
