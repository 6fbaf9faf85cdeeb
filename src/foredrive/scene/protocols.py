"""What the parts of Foredrive ask of each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from foredrive.scene.clip import Clip
from foredrive.scene.frames import Frames
from foredrive.scene.record import Record
from foredrive.scene.rig import CameraRig
from foredrive.scene.sweep import LidarSweep
from foredrive.scene.trajectory import Trajectory
from foredrive.scene.voxels import VoxelSpec

Task = Literal["occupancy", "forecast", "plan"]
"""What features are wanted for: the scene now, the scene later, a path."""


@dataclass(frozen=True)
class Belief(Record):
    """What a world model holds to be the case at one time, in the ego frame of that time."""

    volume: Float[Tensor, "b D Z Y X"]
    state: Float[Tensor, "b S"] | None = None
    """Latent state, for models that have one."""
    history: Float[Tensor, "b T D Z Y X"] | None = None
    """Volumes of the past frames, now last, where imagining needs them."""
    statics: Float[Tensor, "b _C Y X"] | None = None
    """What stands, as features of the plane, for models that hand it on without warping."""
    flow_mps: Float[Tensor, "b 3 Z Y X"] | None = None
    """Velocity over ground of each voxel's content, in the ego axes, where imagining it gave one."""
    T_now_ego: Float[Tensor, "b 4 4"] | None = None
    """Predicted ego motion: this belief's ego frame -> the ego frame at now; None for now's belief."""


@dataclass(frozen=True)
class Decoded(Record):
    """What can be read off a belief."""

    occupancy_logit: Float[Tensor, "b Z Y X"]
    feature: Float[Tensor, "b D Z Y X"]
    """Features to composite along rays."""
    flow: Float[Tensor, "b 3 Z Y X"] | None = None
    """Velocity of each voxel's content in the ego axes, m/s."""
    action: Float[Tensor, "b A"] | None = None


class RenderedRays(NamedTuple):
    """What R rays through a volume see."""

    rgb: Float[Tensor, "b R 3"]
    """0 to 1."""
    range_m: Float[Tensor, "b R"]
    """Expected distance of the hit; a ray without a hit counts with the far end."""
    alpha: Float[Tensor, "b R"]
    """Probability that the ray ends inside the volume."""


@runtime_checkable
class RayRenderer(Protocol):
    """Renders colour and range along rays through a decoded belief."""

    def __call__(
        self,
        feature: Float[Tensor, "b D Z Y X"],
        occupancy_logit: Float[Tensor, "b Z Y X"],
        origin: Float[Tensor, "b R 3"],
        direction: Float[Tensor, "b R 3"],
        generator: torch.Generator | None = None,
    ) -> RenderedRays:
        """Render rays given in the belief's ego frame; a generator jitters the samples along them."""
        ...


@runtime_checkable
class WorldModel(Protocol):
    """Observes the present, imagines the next key frames and decodes both (NeMo, DriveWorld).

    An implementation is a `torch.nn.Module` too: its parameters are what training changes.
    """

    @property
    def spec(self) -> VoxelSpec:
        """The grid of its volumes."""
        ...

    @property
    def channels(self) -> int:
        """D, the channels of its volumes."""
        ...

    @property
    def past_frames(self) -> int:
        """The number of key frames before now that it reads."""
        ...

    @property
    def dt_s(self) -> float:
        """The time between key frames, s."""
        ...

    @property
    def max_steps(self) -> int | None:
        """The most key frames it imagines; None if there is no limit."""
        ...

    @property
    def samples_futures(self) -> bool:
        """Whether `imagine` draws another future with each state of its generator."""
        ...

    @property
    def renderer(self) -> RayRenderer | None:
        """Renders what it decodes; None if the model cannot be rendered."""
        ...

    def observe(self, clip: Clip) -> Belief:
        """Return the belief about now from the frames up to now.

        Raises:
            InputError: the clip shows the future or has too few frames.
        """
        ...

    def encode(self, frames: Frames) -> Belief:
        """Return the belief about now from T = `past_frames` + 1 frames.

        No step depends on the values of the data, so that it can be traced for export.
        """
        ...

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K A"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """Return the next `steps` key frames, each in its own predicted ego frame.

        Args:
            actions: given to models that take actions.
            generator: draws one of many futures from models that sample; without one they return the mean.
        """
        ...

    def decode(self, belief: Belief) -> Decoded:
        """Return occupancy, flow and renderable features of a belief."""
        ...

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume of a belief as the head of a task reads it."""
        ...


@runtime_checkable
class Agent(Protocol):
    """Something that drives."""

    def act(self, observation: Clip) -> Trajectory:
        """The plan from now on, in the ego frame at now."""
        ...


@dataclass(frozen=True)
class Control:
    """What moves the vehicle for one simulation step."""

    acceleration_mps2: float
    steering_rad: float
    """Front-wheel angle, positive to the left."""


@dataclass(frozen=True)
class Event:
    """Something a simulator noticed: a collision, a red light run, a route's end."""

    kind: str
    t_s: float
    xy_world: tuple[float, float]
    detail: str = ""
    what: str = ""
    """What was hit or run."""
    severity: float = 0.0
    """Of a collision the speed at which it came about, m/s; of leaving the lanes the way driven so, m."""


@dataclass(frozen=True)
class Step:
    """What follows from one control."""

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
    """Never negative: nobody reverses."""
    steering_rad: float = 0.0
    """Front-wheel angle, positive to the left."""
    acceleration_mps2: float = 0.0
    """Of the speed, as engine and brakes have it now; 0 while the vehicle stands."""


@dataclass(frozen=True)
class Standing:
    """How far a drive has come."""

    completion: float
    """Share of the route, 0 to 1."""
    outside_lanes: float
    """Share of the way driven outside of the lanes or against them, 0 to 1."""
    driven_m: float


@runtime_checkable
class Simulator(Protocol):
    """A world to drive a route in: a town, a rebuilt log, CARLA."""

    def reset(self, scenario: Any) -> Clip:
        """Start a drive and return its first key frame."""
        ...

    def step(self, control: Control) -> Step:
        """Drive on for one simulation step; an event's kind tells why a drive is over."""
        ...

    def ego(self) -> BicycleState:
        """The ego vehicle now."""
        ...

    def standing(self) -> Standing:
        """How far the drive has come."""
        ...


@dataclass(frozen=True)
class Rendered(Record):
    """What the sensors of a vehicle see at one time, unbatched."""

    images: UInt8[Tensor, "C 3 H W"]
    """RGB, in the order of the renderer's rig."""
    sweep: LidarSweep | None
    """One revolution in the ego frame, beams that do not return included; None: there is no lidar."""


@runtime_checkable
class Renderer(Protocol):
    """A scene as the sensors of a vehicle see it that may be anywhere in it: a rebuilt log."""

    @property
    def rig(self) -> CameraRig:
        """The cameras, without leading dimensions, all exposed at the time that is asked for."""
        ...

    def render(
        self, T_world_ego: Float64[Tensor, "4 4"], twist_ego: Float[Tensor, "6"], t_s: float
    ) -> Rendered:
        """What is seen from a pose at a time of the scene.

        Args:
            T_world_ego: where the vehicle is.
            twist_ego: its velocity (m/s), then turn rate (rad/s), over ground in its own axes.
            t_s: since the scene's first moment.
        """
        ...
