"""What the parts of Foredrive ask of each other."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from jaxtyping import Float, Float64
from torch import Tensor

from foredrive.scene.clip import Clip
from foredrive.scene.record import Record
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


@runtime_checkable
class WorldModel(Protocol):
    """A model of what is around and what comes next (NeMo, DriveWorld)."""

    spec: VoxelSpec

    def observe(self, clip: Clip) -> Belief:
        """What the frames up to now say about now. Raises InputError on a clip that shows the future."""
        ...

    def imagine(
        self, belief: Belief, steps: int, actions: Float[Tensor, "b K A"] | None = None
    ) -> list[Belief]:
        """The next `steps` key frames, each in its own predicted ego frame."""
        ...

    def decode(self, belief: Belief) -> Decoded:
        """Occupancy, flow and renderable features of a belief."""
        ...

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """The volume of a belief as the head of a task is given it."""
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


class Simulator(Protocol):
    """A world that answers: a town, a rebuilt log, CARLA."""

    def reset(self, scenario: Any) -> Clip:
        """Start a scenario and return the first observation."""
        ...

    def step(self, control: Control) -> Step:
        """Advance by one simulation step."""
        ...


@dataclass(frozen=True)
class Rendered(Record):
    """What a sensor would have seen; R rays."""

    rgb: Float[Tensor, "*R 3"]
    range_m: Float[Tensor, "*R"]
    intensity: Float[Tensor, "*R"]
    drop: Float[Tensor, "*R"]
    """Probability that a lidar ray does not return."""
    alpha: Float[Tensor, "*R"]


class Renderer(Protocol):
    """Something that turns a scene into sensor data."""

    def render(self, scene: Any, sensor: Any, pose: Float64[Tensor, "4 4"], t_s: float) -> Rendered:
        """Render one sensor at one pose and time."""
        ...
