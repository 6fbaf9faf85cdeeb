"""DriveWorld's world model: images to planes, latent dynamics and statics, occupancy now and later (§3)."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Discriminator
from torch import Tensor, nn
from torch.nn.functional import conv3d

from foredrive.errors import InputError
from foredrive.geometry.se3 import compose_se3, inverse_se3
from foredrive.methods.blocks.backbone import BackboneConfig, ImageBackbone
from foredrive.methods.blocks.lift_splat import LiftSplatConfig, LiftSplatEncoder
from foredrive.methods.blocks.lifting import lift_frames
from foredrive.methods.blocks.pooled_lifting import PooledLiftingConfig, PooledLiftingEncoder
from foredrive.methods.driveworld.actions import actions_in, motion_of
from foredrive.methods.driveworld.gaussian import DiagonalGaussian
from foredrive.methods.driveworld.planes import (
    PlanesToVolume,
    PlanesToVolumeConfig,
    PlaneToVector,
    PlaneToVectorConfig,
    StaticScene,
    StaticSceneConfig,
    VectorToPlane,
    VectorToPlaneConfig,
    warp_plane,
)
from foredrive.methods.driveworld.state_space import Latent, StateSpace, StateSpaceConfig
from foredrive.methods.driveworld.task_prompt import Prompt, PromptConfig, TaskPrompt, encode_prompts
from foredrive.scene import Belief, Clip, Decoded, Frames, Task, VoxelSpec, last_frames
from foredrive.scene.record import Record

Encoder = LiftSplatEncoder | PooledLiftingEncoder
ENCODERS: Mapping[type, Callable[..., Encoder]] = {
    LiftSplatConfig: LiftSplatEncoder,
    PooledLiftingConfig: PooledLiftingEncoder,
}
"""Encoder class per config. Each takes the config, the grid, the channels of image features and of the plane,
and the number of image feature levels."""


@dataclass(frozen=True, kw_only=True)
class DriveWorldConfig:
    """Sizes of a `DriveWorld`."""

    backbone: BackboneConfig
    encoder: Annotated[PooledLiftingConfig | LiftSplatConfig, Discriminator("kind")]
    states: StateSpaceConfig
    channels: int
    """D, channels of the volume and of the image features."""
    plane_channels: int
    """C, channels of the plane that images are lifted to."""
    to_vector: PlaneToVectorConfig
    """From a plane to x_t."""
    from_vector: VectorToPlaneConfig
    """From a state to a plane (m_θ)."""
    to_volume: PlanesToVolumeConfig
    """From planes to the volume (l_θ)."""
    statics: StaticSceneConfig | None
    """Latent statics; None disables Static Scene Propagation."""
    prompt: PromptConfig | None
    """Task prompts; None disables them."""
    warp_statics: bool = False
    """Warp the latent statics by the ego motion: the driven path and, in imagination, the actions. The paper
    passes them on without warping."""
    occupied_prior: float = 0.02
    """Initial occupancy probability. It is small because most space is free."""
    kind: Literal["driveworld"] = "driveworld"


@dataclass(frozen=True)
class LiftedFrames(Record):
    """The last T frames of a clip, lifted to planes, before any processing in time."""

    planes: Float[Tensor, "b T C Y X"]
    """One plane per frame, each in its own ego frame."""
    actions: Float[Tensor, "b T 2"]
    """Actions at each frame; zeros at the last."""
    T_now_ego: Float[Tensor, "b T 4 4"]
    """Transform from the ego frame of each frame to that of the last."""


@dataclass(frozen=True)
class Unrolled:
    """One pass over the frames of a clip, for training."""

    beliefs: tuple[Belief, ...]
    """Beliefs of the T observed frames, then of the L imagined ones. `T_now_ego` leads to the frame of the
    statics."""
    posteriors: tuple[DiagonalGaussian, ...]
    """Posteriors of the observed frames."""
    priors: tuple[DiagonalGaussian, ...]
    actions: Float[Tensor, "b K 2"]
    """Actions of the policy π at every frame of `beliefs`."""
    velocities_mps: Float[Tensor, "b T M 2"]
    """Estimated velocities (m/s) of moving objects at the observed frames."""


class DriveWorld(nn.Module):
    """A `WorldModel`. Beliefs of later frames are in the ego frames of those frames; volumes are not warped.

    Args:
        config: sizes.
        spec: grid of the volume.
        past_frames: T - 1.
        dt_s: time between key frames, s.
        fetch: load the weights of the backbone and encode the task prompts. Not needed when trained weights
            replace them later.

    Raises:
        InputError: the text encoder cannot be loaded.
    """

    max_steps = None
    samples_futures = True
    renderer = None

    def __init__(
        self, config: DriveWorldConfig, spec: VoxelSpec, *, past_frames: int, dt_s: float, fetch: bool = True
    ) -> None:
        super().__init__()
        channels, plane, states = config.channels, config.plane_channels, config.states
        height, size_yx = spec.shape_zyx[0], spec.shape_zyx[1:]
        self.spec, self.channels, self.past_frames, self.dt_s = spec, channels, past_frames, dt_s
        self.warp_statics = config.warp_statics
        finest_alone = isinstance(config.encoder, LiftSplatConfig)
        levels = 1 if finest_alone else config.backbone.levels or len(config.backbone.stages)
        self.backbone = ImageBackbone(config.backbone, channels=channels, levels=levels, fetch=fetch)
        self.encoder = ENCODERS[type(config.encoder)](
            config.encoder, spec, channels=channels, plane_channels=plane, levels=levels
        )
        self.states = StateSpace(states)
        self.to_vector = PlaneToVector(config.to_vector, channels=plane, vector=states.observation)
        self.from_vector = VectorToPlane(
            config.from_vector, vector=states.history + states.state, size_yx=size_yx
        )
        # The volume reads three planes side by side: state, statics, prompt
        planes = config.from_vector.widths[-1]
        planes += 0 if config.statics is None else config.statics.channels
        planes += 0 if config.prompt is None else config.prompt.expand.widths[-1]
        self.to_volume = PlanesToVolume(config.to_volume, channels=planes, out=channels, height=height)
        self.statics = None if config.statics is None else StaticScene(config.statics, channels=plane)
        self.prompt: TaskPrompt | None = None
        if config.prompt is not None:
            # Zeros stand for encodings that loaded weights replace
            encodings = torch.zeros(len(config.prompt.prompts), config.prompt.encoding)
            encodings = encode_prompts(config.prompt) if fetch else encodings
            self.prompt = TaskPrompt(config.prompt, encodings, size_yx)
        self.occupancy = nn.Linear(channels, 1)
        prior = config.occupied_prior
        # Log-odds of the prior occupancy
        nn.init.constant_(self.occupancy.bias, math.log(prior / (1 - prior)))
        self.flow = nn.Linear(channels, 3)
        for parameter in self.flow.parameters():
            nn.init.zeros_(parameter)  # start with zero flow

    def observe(self, clip: Clip) -> Belief:
        """Return the belief about now, from the means of the posteriors and the statics of now.

        Raises:
            InputError: the clip contains future frames or has too few frames.
        """
        return self.encode(last_frames(clip, self.past_frames))

    def encode(self, frames: Frames) -> Belief:
        """Do the work of `observe`. No step depends on the values of the data."""
        return self.belief_about_now(self.lift_frames(frames))

    def lift_frames(self, frames: Frames) -> LiftedFrames:
        """Lift each of the last T frames to a plane."""
        planes, _ = lift_frames(frames, self.backbone, self.encoder)
        return LiftedFrames(planes, actions_in(frames), frames.T_now_ego.float())

    def belief_about_now(self, lifted: LiftedFrames) -> Belief:
        """Return the belief of `observe` from frames that are already lifted."""
        # Means of the posteriors make the belief deterministic
        latents, *_ = self._filter(lifted, None)
        return self._belief(latents[-1], self._statics(lifted.planes[:, -1]), "occupancy", None)

    def imagine(
        self,
        belief: Belief,
        steps: int,
        actions: Float[Tensor, "b K 2"] | None = None,
        generator: torch.Generator | None = None,
    ) -> list[Belief]:
        """Imagine the next `steps` key frames under the given actions or those of the model's own policy.

        Args:
            actions: velocity (m/s) and steering angle (rad) at now and at the frames after it.
            generator: draws states from the prior; without it, states are the means of the prior.

        Raises:
            InputError: the belief is not from this model, or there are too few actions.
        """
        if belief.state is None or belief.statics is None:
            raise InputError("DriveWorld imagines only from beliefs that it made itself")
        if steps < 1 or (actions is not None and actions.shape[1] < steps):
            given = "its own" if actions is None else f"{actions.shape[1]} given"
            raise InputError(f"DriveWorld imagines one step or more; asked for {steps} with {given} actions")
        latent, statics = self._unpack(belief.state), belief.statics
        T_now_ego = belief.T_now_ego
        # An observed belief has no pose of its own: it is at now
        if T_now_ego is None:
            T_now_ego = torch.eye(4, device=statics.device).expand(len(statics), 4, 4)
        futures = []
        for k in range(steps):
            # Without given actions, the model follows its own policy
            action = self.states.action(latent) if actions is None else actions[:, k]
            latent, prior = self._step(latent, action)
            state = prior.mean if generator is None else prior.sample(generator)
            latent = _with_state(latent, state)
            # The ego pose follows from the action by the bicycle model
            T_now_ego = compose_se3(T_now_ego, motion_of(action, self.dt_s))
            futures.append(self._belief(latent, statics, "forecast", T_now_ego))
        return futures

    def decode(self, belief: Belief) -> Decoded:
        """Decode occupancy, flow and the action of the policy."""
        # One convolution for both heads, in the memory layout of the volume: two linear layers over voxels
        # would make a step a tenth longer.
        heads = (self.occupancy, self.flow)
        weight = torch.cat([head.weight for head in heads])[:, :, None, None, None]
        both = conv3d(belief.volume, weight, torch.cat([head.bias for head in heads])).float()
        logit, flow = both[:, 0], both[:, 1:]
        action = None if belief.state is None else self.states.action(self._unpack(belief.state))
        return Decoded(occupancy_logit=logit, feature=belief.volume, flow=flow, action=action)

    def volume_for(self, belief: Belief, task: Task) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume under the prompt of a task. Without prompts it is that of the belief.

        The prompt for the occupancy of an imagined belief is the one that it was imagined under.
        """
        if self.prompt is None:
            return belief.volume
        if belief.state is None or belief.statics is None:
            raise InputError("DriveWorld reads only beliefs that it made itself")
        # Statics are stored in the frame of the belief they came from
        statics = self._warped_statics(belief.statics, belief.T_now_ego)
        imagined = task == "occupancy" and belief.T_now_ego is not None
        return self._volume(self._unpack(belief.state), statics, "forecast" if imagined else task)

    def unroll(
        self,
        lifted: LiftedFrames,
        steps: int,
        generator: torch.Generator | None,
        statics_of: Literal["random", "now"] = "random",
    ) -> Unrolled:
        """Return all that training needs: T frames observed by the posterior, `steps` imagined by the prior.

        Args:
            generator: samples the states. Without it, states are means and the statics are those of now.
            statics_of: frame whose statics all frames are decoded with (§3.1: a random one, drawn per item).
        """
        latents, posteriors, priors = self._filter(lifted, generator)
        frames = len(latents)
        batch = len(lifted.planes)
        # Frame of the statics: now, or one drawn for each item
        source = torch.full((batch,), frames - 1)
        if generator is not None and statics_of == "random":
            source = torch.randint(frames, (batch,), generator=generator)
        chosen = torch.arange(batch), source
        statics = self._statics(lifted.planes[chosen])
        # Every belief knows its pose in the frame of the statics
        T_source_now = inverse_se3(lifted.T_now_ego[chosen])
        T_source_ego = compose_se3(T_source_now[:, None], lifted.T_now_ego)
        beliefs = [
            self._belief(latent, statics, "occupancy", T_source_ego[:, k]) for k, latent in enumerate(latents)
        ]
        policy = [self.states.action(step_latent) for step_latent in latents]
        # Imagined frames continue from the last observed latent, under the policy's own actions
        latent, T = latents[-1], T_source_now
        for _ in range(steps):
            T = compose_se3(T, motion_of(policy[-1], self.dt_s))
            latent, prior = self._step(latent, policy[-1])
            latent = _with_state(latent, prior.mean if generator is None else prior.sample(generator))
            beliefs.append(self._belief(latent, statics, "forecast", T))
            policy.append(self.states.action(latent))
        return Unrolled(
            beliefs=tuple(beliefs),
            posteriors=tuple(posteriors),
            priors=tuple(priors),
            actions=torch.stack(policy, dim=1),
            velocities_mps=torch.stack(
                [self.states.velocities_mps(step_latent.state) for step_latent in latents], dim=1
            ),
        )

    def single_frame_beliefs(self, lifted: LiftedFrames) -> list[Belief]:
        """Return a belief about each frame from its own plane only, as in single-frame pre-training."""
        # The initial latent is the same for every frame, so only the plane tells frames apart
        latent = self.states.initial(len(lifted.planes), lifted.planes.device)
        return [
            self._belief(latent, self._statics(plane), "occupancy", None)
            for plane in lifted.planes.unbind(dim=1)
        ]

    def _filter(
        self, lifted: LiftedFrames, generator: torch.Generator | None
    ) -> tuple[list[Latent], list[DiagonalGaussian], list[DiagonalGaussian]]:
        """Return latents, posteriors and priors of the observed frames. The first prior is N(0, I).

        States are sampled with `generator`; without it, they are the means of the posteriors.
        """
        b, frames = lifted.planes.shape[:2]
        vectors = self.to_vector(lifted.planes.flatten(0, 1)).unflatten(0, (b, frames))
        latent = self.states.initial(b, lifted.planes.device)
        prior, last = DiagonalGaussian.standard(latent.state), torch.zeros_like(lifted.actions[:, 0])
        latents, posteriors, priors = [], [], []
        for t in range(frames):
            # The prior follows the policy's action, the posterior the driven one
            if t > 0:
                latent, prior = self._step(latent, self.states.action(latent))
                last = lifted.actions[:, t - 1]
            posterior = self.states.posterior(latent, last, vectors[:, t])
            state = posterior.mean if generator is None else posterior.sample(generator)
            latent = _with_state(latent, state)
            latents.append(latent)
            posteriors.append(posterior)
            priors.append(prior)
        return latents, posteriors, priors

    def _step(self, latent: Latent, action: Float[Tensor, "b 2"]) -> tuple[Latent, DiagonalGaussian]:
        """Advance by one key frame. Return the latent with its new history and the prior of its state."""
        dt_s = torch.full_like(latent.history[:, 0], self.dt_s)
        latent = self.states.transition(latent, dt_s)
        return latent, self.states.prior(latent, action)

    def _statics(self, plane: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b _S Y X"]:
        """Return the statics b̂ of a plane; no channels without Static Scene Propagation."""
        return plane[:, :0] if self.statics is None else self.statics(plane)

    def _warped_statics(
        self, statics: Float[Tensor, "b _S Y X"], T_source_ego: Float[Tensor, "b 4 4"] | None
    ) -> Float[Tensor, "b _S Y X"]:
        """Return the statics in the frame of another belief: warped if `warp_statics`, else unchanged."""
        if not self.warp_statics or T_source_ego is None:
            return statics
        return warp_plane(statics, T_source_ego, self.spec)

    def _belief(
        self,
        latent: Latent,
        statics: Float[Tensor, "b _S Y X"],
        prompt: Prompt,
        T_now_ego: Float[Tensor, "b 4 4"] | None,
    ) -> Belief:
        volume = self._volume(latent, self._warped_statics(statics, T_now_ego), prompt)
        return Belief(volume=volume, state=_pack(latent), statics=statics, T_now_ego=T_now_ego)

    def _volume(
        self, latent: Latent, statics: Float[Tensor, "b _S Y X"], prompt: Prompt
    ) -> Float[Tensor, "b D Z Y X"]:
        """Apply m_θ and l_θ: decode a state and the statics into a volume of features."""
        # The decoder reads the refined history h̃
        history = latent.history if self.states.recall is None else self.states.recall(latent)
        planes = [self.from_vector(torch.cat([history, latent.state], dim=-1)), statics]
        if self.prompt is not None:
            planes.append(self.prompt(prompt, len(statics)))
        volume: Tensor = self.to_volume(torch.cat(planes, dim=1))
        return volume

    def _unpack(self, state: Float[Tensor, "b _P"]) -> Latent:
        """Undo `_pack`."""
        history, size, memory = self.states.sizes
        parts = state.split([history, size, memory * history, memory], dim=-1)
        # The flags of the memory were packed as 0 and 1
        return Latent(parts[0], parts[1], parts[2].unflatten(-1, (memory, history)), parts[3] > 0.5)


def _pack(latent: Latent) -> Float[Tensor, "b _P"]:
    """Pack a latent into one vector, for a `Belief`."""
    parts = (latent.history, latent.state, latent.memory.flatten(1), latent.memory_valid.to(latent.state))
    return torch.cat(parts, dim=-1)


def _with_state(latent: Latent, state: Float[Tensor, "b S"]) -> Latent:
    return Latent(latent.history, state, latent.memory, latent.memory_valid)
