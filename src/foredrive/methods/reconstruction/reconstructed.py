"""A reconstructed scene: what every representation of a log has, and what it can do."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors import safe_open
from torch import Tensor, nn

from foredrive.geometry.se3 import exp_se3
from foredrive.methods.reconstruction.rendered import RenderedImage, RenderedSweep
from foredrive.methods.reconstruction.scene_graph import Content, SceneGraph
from foredrive.methods.reconstruction.tracks import PER_TRACK, ActorTracks
from foredrive.methods.reconstruction.views import CameraView, SweepView

OBSTACLE = "obstacle_"
"""Beginning of the names of the obstacles' buffers."""
_FIRST_VELOCITY_MPS, _FIRST_TURN_RADPS = 0.05, 5e-5
"""Bounds of the initial corrections of the frames' velocities."""


class SensorMotion(NamedTuple):
    """A camera as learned, when its middle row is exposed."""

    T_scene_cam: Float[Tensor, "4 4"]
    twist_cam: Float[Tensor, "6"]
    """Velocity (m/s), then turn rate (rad/s) over ground, in its own axes."""
    t_s: Float[Tensor, ""]
    """Time since the start of the drive."""


class ReconstructedScene(nn.Module, ABC):
    """A scene of a log: learned tracks, learned corrections of its sensors, and a representation.

    A subclass holds what is learned of the static part and of the actors, and renders it. Its parameters that
    are named here have the same names in the files of all representations.

    Args:
        tracks: actors.
        cameras: number of cameras in the rig.
        reach_m: range beyond which nothing stops a beam, m.
        frames: number of training images and sweeps, in this order, with velocities of their own.
        frame_velocities: learn corrections of the velocity and turn rate of each training image and sweep.
    """

    preview_name = "splats"
    """What `Content.preview` shows of it, for people."""
    category: Tensor
    key_t_s: Tensor
    present: Tensor
    size_lwh: Tensor
    track_id: Tensor
    T_scene_actor: Tensor

    def __init__(
        self, tracks: ActorTracks, cameras: int, reach_m: float, frames: int, frame_velocities: bool = False
    ) -> None:
        super().__init__()
        self.reach_m = reach_m
        for name in PER_TRACK:
            self.register_buffer(name, getattr(tracks, name))
        self.register_buffer("key_t_s", tracks.t_s)
        # No obstacles at first: buffers of length 0, which are not saved
        self.keep_obstacles(tracks.only(torch.zeros_like(tracks.present[:, 0])))
        self.actor_offset = nn.Parameter(torch.zeros(*tracks.present.shape, 6))
        """Offsets of key poses, in the actors' own axes: m, rad."""
        self.camera_offset = nn.Parameter(torch.zeros(cameras, 6))
        """Offsets of the camera mounts, in the cameras' own axes: m, rad."""
        self.camera_twist = nn.Parameter(torch.zeros(cameras, 6))
        """Corrections of the cameras' velocities and turn rates."""
        self.camera_late_s = nn.Parameter(torch.zeros(cameras))
        """Delay of each camera's exposure with respect to its logged time, s."""
        self.frame_velocity = self.frame_turn = None
        if frame_velocities:
            # Small random values instead of zeros at the start
            self.frame_velocity = nn.Parameter(_FIRST_VELOCITY_MPS * (2 * torch.rand(frames, 3) - 1))
            self.frame_turn = nn.Parameter(_FIRST_TURN_RADPS * (2 * torch.rand(frames, 3) - 1))

    @property
    @abstractmethod
    def content(self) -> Content:
        """The static part and the actors with their current parameters."""

    @property
    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """Numbers of what the scene is made of, such as {"gaussians": 275000}."""

    @abstractmethod
    def camera(self, graph: SceneGraph, view: CameraView) -> RenderedImage:
        """Render an image.

        Args:
            graph: this scene, or an edited version of it.
            view: the camera; its image is not read.
        """

    @abstractmethod
    def prepare_sweep(self, view: SweepView) -> Any:
        """Return the beams of a sweep in the form that `sweep` needs. Their ranges are not read."""

    @abstractmethod
    def sweep(self, graph: SceneGraph, points: Any, t_s: float) -> RenderedSweep:
        """Render a sweep.

        Args:
            graph: this scene, or an edited version of it.
            points: result of `prepare_sweep`.
            t_s: time of the sweep.
        """

    def resize(self, file: Path) -> None:
        """Resize the parameters for the weights in a file, where training changes their sizes.

        Raises:
            InputError: the file cannot be read or holds no weights of such a scene.
        """

    @property
    def described(self) -> str:
        """What the scene is made of, for people: "275,000 Gaussians"."""
        return ", ".join(f"{count:,} {name.capitalize()}" for name, count in self.sizes.items())

    @property
    def device(self) -> torch.device:
        """The device of the scene. Views are moved there."""
        return self.T_scene_actor.device

    @property
    def tracks(self) -> ActorTracks:
        """The tracks with learned offsets."""
        logged = ActorTracks(
            self.track_id, self.category, self.size_lwh, self.key_t_s, self.T_scene_actor, self.present
        )
        return logged.moved(self.actor_offset)

    def keep_obstacles(self, tracks: ActorTracks) -> None:
        """Take over the tracks of what belongs to the static part. Nothing of it is learned."""
        for name in PER_TRACK:
            # Empty buffers are not saved, so weights without obstacles have no such entries
            self.register_buffer(OBSTACLE + name, getattr(tracks, name), persistent=len(tracks) > 0)

    def restore_obstacles(self, file: Path) -> None:
        """Take over the obstacles in saved weights, which are to be loaded afterwards."""
        with safe_open(file, "pt") as saved:
            # Weights load only into buffers of their own sizes
            names = [OBSTACLE + name for name in PER_TRACK if OBSTACLE + name in saved.keys()]  # noqa: SIM118
            if names:
                entries = {name: saved.get_tensor(name) for name in (*names, "key_t_s")}
                self.keep_obstacles(saved_tracks(entries, OBSTACLE))

    @property
    def obstacles(self) -> ActorTracks:
        """The tracks of what belongs to the static part."""
        return ActorTracks(t_s=self.key_t_s, **{name: getattr(self, OBSTACLE + name) for name in PER_TRACK})

    @property
    def graph(self) -> SceneGraph:
        """The scene with its current parameters."""
        return SceneGraph(self.tracks, self.content, self.obstacles)

    def frame_twist(self, frame: int | None) -> Float[Tensor, "6"]:
        """Return the learned correction of a training frame's twist; 0 for None, and if there are none."""
        if frame is None or self.frame_velocity is None or self.frame_turn is None:
            return self.actor_offset.new_zeros(6)
        return torch.cat([self.frame_velocity[frame], self.frame_turn[frame]])

    def corrected_camera(self, view: CameraView, frame: int | None = None) -> SensorMotion:
        """Return pose, motion and time of a view with the learned corrections of its camera.

        Args:
            view: the camera as logged.
            frame: index of a training image, for `frame_twist`.
        """
        late_s, twist = self.camera_late_s[view.sensor], view.twist_cam + self.camera_twist[view.sensor]
        if frame is not None:
            twist = twist + self.frame_twist(frame)
        # First the mount's offset, then the motion during the delay, both in the camera's own axes
        T_scene_cam = view.T_scene_cam @ exp_se3(self.camera_offset[view.sensor]) @ exp_se3(late_s * twist)
        return SensorMotion(T_scene_cam, twist, view.t_s + late_s)


def saved_tracks(saved: Mapping[str, Tensor], prefix: str = "") -> ActorTracks:
    """Return the tracks in the saved weights of a scene, without learned offsets.

    Args:
        saved: the weights.
        prefix: "" for the actors, `OBSTACLE` for what belongs to the static part.

    Raises:
        KeyError: an entry is missing.
    """
    return ActorTracks(t_s=saved["key_t_s"], **{name: saved[prefix + name] for name in PER_TRACK})
