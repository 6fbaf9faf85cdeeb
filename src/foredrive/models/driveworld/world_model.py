"""DriveWorld's world model: images to planes, latent dynamics and statics, occupancy now and later (§3)."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv3d

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3
from foredrive.models.backbone import ImageBackbone
from foredrive.models.driveworld.actions import actions_of, motion_of
from foredrive.models.driveworld.gaussian import DiagonalGaussian
from foredrive.models.driveworld.planes import (
    PlanesToVolume,
    PlaneToVector,
    StaticScene,
    VectorToPlane,
    carried_plane,
)
from foredrive.models.driveworld.state_space import Latent, StateSpace
from foredrive.models.driveworld.task_prompt import TaskPrompt
from foredrive.models.lift_splat import LiftSplatEncoder
from foredrive.models.pooled_lifting import PooledLiftingEncoder
from foredrive.scene import Belief, Clip, Decoded, Task, VoxelSpec
from foredrive.scene.record import Record

OCCUPIED_PRIOR = 0.02
"""Where occupancy starts: most of space is free."""


@dataclass(frozen=True)
class Seen(Record):
    """The last T frames of a clip before anything is made of them in time."""

    planes: Float[Tensor, "b T C Y X"]
    """Each in its own ego frame."""
    actions: Float[Tensor, "b T 2"]
    """What was done at each but the last; zeros there."""
    T_now_ego: Float[Tensor, "b T 4 4"]
    """Each frame's ego frame -> that of the last."""


@dataclass(frozen=True)
class Unrolled:
    """One pass over the frames of a clip, for training."""

    beliefs: tuple[Belief, ...]
    """Of the T observed frames, then of the L imagined ones; `T_now_ego` leads to the statics' frame."""
    posteriors: tuple[DiagonalGaussian, ...]
    """Of the observed frames."""
    priors: tuple[DiagonalGaussian, ...]
    actions: Float[Tensor, "b K 2"]
    """π's at every frame of `beliefs`."""
    velocities_mps: Float[Tensor, "b T M 2"]
    """Of moving objects, estimated at the observed frames."""


class DriveWorld(nn.Module):
    """A `WorldModel`. Beliefs of later frames are in those frames' own ego frames, nothing is warped.

    Args:
        backbone: image features.
        encoder: image features to a plane of `plane` channels.
        states: the state-space model.
        to_vector: the plane as x_t.
        from_vector: (h̃, s) as a plane, m_θ.
        to_volume: all planes as a volume, l_θ.
        statics: Static Scene Propagation; None leaves it out (the rows of plain dynamics).
        carry_statics: move latent statics along with the ego vehicle, by the driven path and, where that is
            imagined, by the actions. The paper hands them on as they are.
        prompt: task prompts; None leaves them out.
        past_frames: T - 1.
        dt_s: between key frames.
        channels: D of the volume.
    """

    def __init__(
        self,
        *,
        backbone: ImageBackbone,
        encoder: LiftSplatEncoder | PooledLiftingEncoder,
        states: StateSpace,
        to_vector: PlaneToVector,
        from_vector: VectorToPlane,
        to_volume: PlanesToVolume,
        statics: StaticScene | None,
        carry_statics: bool,
        prompt: TaskPrompt | None,
        past_frames: int,
        dt_s: float,
        channels: int,
    ) -> None:
        super().__init__()
        self.backbone, self.encoder, self.states = backbone, encoder, states
        self.to_vector, self.from_vector, self.to_volume = to_vector, from_vector, to_volume
        self.statics, self.carry_statics, self.prompt = statics, carry_statics, prompt
        self.past_frames, self.dt_s = past_frames, dt_s
        self.occupancy = nn.Linear(channels, 1)
        nn.init.constant_(self.occupancy.bias, math.log(OCCUPIED_PRIOR / (1 - OCCUPIED_PRIOR)))
        self.flow = nn.Linear(channels, 3)
        for parameter in self.flow.parameters():
            nn.init.zeros_(parameter)  # nothing moves until it is learned

    @property
    def spec(self) -> VoxelSpec:
        """The volume's grid."""
        return self.encoder.spec

    def observe(self, clip: Clip) -> Belief:
        """What the last T frames say about now, by the posterior's means; statics are now's.

        Raises:
            InputError: if the clip shows the future or has too few frames.
        """
        return self.believe(self.see(clip))

    def see(self, clip: Clip) -> Seen:
        """The last T frames as planes; raises as `observe` does."""
        frames = clip.t_s.shape[-1]
        if clip.now != frames - 1:
            raise InputError("a world model observes frames up to now only: pass clip.observed()")
        if frames < self.past_frames + 1:
            raise InputError(
                f"DriveWorld needs {self.past_frames} frames before now, the clip has {frames - 1}"
            )
        seen = clip.frames(slice(frames - self.past_frames - 1, frames))
        b, t, c = seen.image_valid.shape
        levels = self.backbone(seen.images.flatten(0, 2))
        features = [level.unflatten(0, (b * t, c)) for level in levels]
        per_image = seen.rig.map_tensors(lambda tensor: tensor.flatten(0, 1))
        planes = self.encoder(features, per_image, seen.image_valid.flatten(0, 1)).unflatten(0, (b, t))
        T_now_ego = inverse_se3(seen.T_world_ego[:, -1:]) @ seen.T_world_ego
        return Seen(planes, actions_of(seen), T_now_ego.float())

    def believe(self, seen: Seen) -> Belief:
        """`observe` of frames that have been seen."""
        latents, *_ = self._filter(seen, None)
        return self._decoded(latents[-1], self._statics(seen.planes[:, -1]), "occupancy", None)

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K 2"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """The next `steps` key frames under given actions, or those of the model's own policy.

        Args:
            actions: velocity, m/s, and steering angle, rad, of now and the frames after it.
            generator: draws states from the prior; without one they are its means.

        Raises:
            InputError: the belief is not one of this model, or there are too few actions.
        """
        if belief.state is None or belief.statics is None:
            raise InputError("DriveWorld imagines from beliefs of its own")
        if steps < 1 or (actions is not None and actions.shape[1] < steps):
            told = "its own" if actions is None else f"{actions.shape[1]} given"
            raise InputError(f"DriveWorld imagines a step or more, {steps} of them with {told} actions")
        latent, statics = self._unpacked(belief.state), belief.statics
        T_now_ego = belief.T_now_ego
        if T_now_ego is None:
            T_now_ego = torch.eye(4, device=statics.device).expand(len(statics), 4, 4)
        futures = []
        for k in range(steps):
            action = self.states.action(latent) if actions is None else actions[:, k]
            latent, prior = self._ahead(latent, action)
            state = prior.mean if generator is None else prior.sample(generator)
            latent = _with_state(latent, state)
            T_now_ego = T_now_ego @ motion_of(action, self.dt_s)
            futures.append(self._decoded(latent, statics, "forecast", T_now_ego))
        return futures

    def decode(self, belief: Belief) -> Decoded:
        """Occupancy, flow, and the policy's action."""
        # both heads at once, where the volume lies: two layers over voxels make a step a tenth longer
        heads = (self.occupancy, self.flow)
        weight = torch.cat([head.weight for head in heads])[:, :, None, None, None]
        read = conv3d(belief.volume, weight, torch.cat([head.bias for head in heads])).float()
        logit, flow = read[:, 0], read[:, 1:]
        action = None if belief.state is None else self.states.action(self._unpacked(belief.state))
        return Decoded(occupancy_logit=logit, feature=belief.volume, flow=flow, action=action)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """The volume under another task's prompt; without prompts that of the belief."""
        if self.prompt is None:
            return belief.volume
        if belief.state is None or belief.statics is None:
            raise InputError("DriveWorld prompts beliefs of its own")
        statics = self._carried(belief.statics, belief.T_now_ego)
        return self._volume(self._unpacked(belief.state), statics, task)

    def unroll(
        self,
        seen: Seen,
        steps: int,
        generator: torch.Generator | None,
        statics_of: Literal["random", "now"] = "random",
    ) -> Unrolled:
        """All that training looks at: T observed frames by the posterior, `steps` imagined by the prior.

        Args:
            generator: samples the states; without one they are means, and statics now's.
            statics_of: the frame whose statics all frames are decoded from (§3.1: a random one).
        """
        latents, posteriors, priors = self._filter(seen, generator)
        frames = len(latents)
        shown = frames - 1
        if generator is not None and statics_of == "random":
            shown = int(torch.randint(frames, (1,), generator=generator))
        statics = self._statics(seen.planes[:, shown])
        T_shown_now = inverse_se3(seen.T_now_ego[:, shown])
        T_shown_ego = T_shown_now[:, None] @ seen.T_now_ego
        beliefs = [
            self._decoded(latent, statics, "occupancy", T_shown_ego[:, k]) for k, latent in enumerate(latents)
        ]
        policy = [self.states.action(each) for each in latents]
        latent, T = latents[-1], T_shown_now
        for _ in range(steps):
            T = T @ motion_of(policy[-1], self.dt_s)
            latent, prior = self._ahead(latent, policy[-1])
            latent = _with_state(latent, prior.mean if generator is None else prior.sample(generator))
            beliefs.append(self._decoded(latent, statics, "forecast", T))
            policy.append(self.states.action(latent))
        return Unrolled(
            beliefs=tuple(beliefs),
            posteriors=tuple(posteriors),
            priors=tuple(priors),
            actions=torch.stack(policy, dim=1),
            velocities_mps=torch.stack([self.states.velocities_mps(each.state) for each in latents], dim=1),
        )

    def without_time(self, seen: Seen) -> list[Belief]:
        """Each observed frame from its own plane alone, as pre-training by single frames looks at them."""
        nothing = self.states.begin(len(seen.planes), seen.planes.device)
        return [
            self._decoded(nothing, self._statics(plane), "occupancy", None)
            for plane in seen.planes.unbind(dim=1)
        ]

    def _filter(
        self, seen: Seen, generator: torch.Generator | None
    ) -> tuple[list[Latent], list[DiagonalGaussian], list[DiagonalGaussian]]:
        """Latents, posteriors and priors of the observed frames; the first prior is N(0, I).

        States are drawn with a generator, the posteriors' means without.
        """
        b, frames = seen.planes.shape[:2]
        vectors = self.to_vector(seen.planes.flatten(0, 1)).unflatten(0, (b, frames))
        latent = self.states.begin(b, seen.planes.device)
        prior, last = DiagonalGaussian.standard(latent.state), torch.zeros_like(seen.actions[:, 0])
        latents, posteriors, priors = [], [], []
        for t in range(frames):
            if t > 0:
                latent, prior = self._ahead(latent, self.states.action(latent))
                last = seen.actions[:, t - 1]
            posterior = self.states.posterior(latent, last, vectors[:, t])
            state = posterior.mean if generator is None else posterior.sample(generator)
            latent = _with_state(latent, state)
            latents.append(latent)
            posteriors.append(posterior)
            priors.append(prior)
        return latents, posteriors, priors

    def _ahead(self, latent: Latent, action: Float[Tensor, "b 2"]) -> tuple[Latent, DiagonalGaussian]:
        """One key frame on: the new history, and what state to expect there."""
        dt_s = torch.full_like(latent.history[:, 0], self.dt_s)
        latent = self.states.transition(latent, dt_s)
        return latent, self.states.prior(latent, action)

    def _statics(self, plane: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b _S Y X"]:
        """b̂; no channels without Static Scene Propagation."""
        return plane[:, :0] if self.statics is None else self.statics(plane)

    def _carried(
        self, statics: Float[Tensor, "b _S Y X"], T_shown_ego: Float[Tensor, "b 4 4"] | None
    ) -> Float[Tensor, "b _S Y X"]:
        """Statics of one frame for another, if they are carried along."""
        if not self.carry_statics or T_shown_ego is None:
            return statics
        return carried_plane(statics, T_shown_ego, self.spec)

    def _decoded(
        self,
        latent: Latent,
        statics: Float[Tensor, "b _S Y X"],
        task: Task,
        T_now_ego: Float[Tensor, "b 4 4"] | None,
    ) -> Belief:
        volume = self._volume(latent, self._carried(statics, T_now_ego), task)
        return Belief(volume=volume, state=_packed(latent), statics=statics, T_now_ego=T_now_ego)

    def _volume(
        self, latent: Latent, statics: Float[Tensor, "b _S Y X"], task: Task
    ) -> Float[Tensor, "b D Z Y X"]:
        """m_θ and l_θ: the features of a state and of what stands."""
        history = latent.history if self.states.recall is None else self.states.recall(latent)
        planes = [self.from_vector(torch.cat([history, latent.state], dim=-1)), statics]
        if self.prompt is not None:
            planes.append(self.prompt(task, len(statics)))
        volume: Tensor = self.to_volume(torch.cat(planes, dim=1))
        return volume

    def _unpacked(self, state: Float[Tensor, "b _P"]) -> Latent:
        """The inverse of `_packed`."""
        history, size, memory = self.states.sizes
        parts = state.split([history, size, memory * history, memory], dim=-1)
        return Latent(parts[0], parts[1], parts[2].unflatten(-1, (memory, history)), parts[3] > 0.5)


def _packed(latent: Latent) -> Float[Tensor, "b _P"]:
    """A latent as one vector, as beliefs carry it."""
    parts = (latent.history, latent.state, latent.memory.flatten(1), latent.remembered.to(latent.state))
    return torch.cat(parts, dim=-1)


def _with_state(latent: Latent, state: Float[Tensor, "b S"]) -> Latent:
    return Latent(latent.history, state, latent.memory, latent.remembered)
