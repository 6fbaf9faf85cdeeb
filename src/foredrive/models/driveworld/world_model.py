"""DriveWorld's world model: images to planes, latent dynamics and statics, occupancy now and later (§3)."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.geometry.se3 import inverse_se3, yaw_of
from foredrive.models.backbone import ImageBackbone
from foredrive.models.driveworld.gaussian import DiagonalGaussian
from foredrive.models.driveworld.planes import PlanesToVolume, PlaneToVector, StaticScene, VectorToPlane
from foredrive.models.driveworld.state_space import Latent, StateSpace
from foredrive.models.driveworld.task_prompt import TaskPrompt
from foredrive.models.lift_splat import LiftSplatEncoder
from foredrive.models.pooled_lifting import PooledLiftingEncoder
from foredrive.scene import Belief, Clip, Decoded, VoxelSpec

OCCUPIED_PRIOR = 0.02
"""Where occupancy starts: most of space is free."""
WHEELBASE_M = 2.86
SLOW_MPS = 0.5
"""A vehicle slower than this is said not to steer: its curvature is noise."""
NOW, FORECAST = "occupancy", "forecast"


@dataclass(frozen=True)
class Unrolled:
    """One pass over the frames of a clip, for training."""

    beliefs: tuple[Belief, ...]
    """Of the T observed frames, then of the L imagined ones."""
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
        prompt: task prompts; None leaves them out.
        past_frames: T - 1.
        dt_s: between key frames.
        channels: D of the volume.
        predicts_flow: whether occupancy flow is read off the volume, too.
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
        prompt: TaskPrompt | None,
        past_frames: int,
        dt_s: float,
        channels: int,
        predicts_flow: bool,
    ) -> None:
        super().__init__()
        self.backbone, self.encoder, self.states = backbone, encoder, states
        self.to_vector, self.from_vector, self.to_volume = to_vector, from_vector, to_volume
        self.statics, self.prompt = statics, prompt
        self.past_frames, self.dt_s = past_frames, dt_s
        self.occupancy = nn.Linear(channels, 1)
        nn.init.constant_(self.occupancy.bias, math.log(OCCUPIED_PRIOR / (1 - OCCUPIED_PRIOR)))
        self.flow = nn.Linear(channels, 3) if predicts_flow else None

    @property
    def spec(self) -> VoxelSpec:
        """The volume's grid."""
        return self.encoder.spec

    def observe(self, clip: Clip) -> Belief:
        """What the last T frames say about now, by the posterior's means; statics are now's.

        Raises:
            InputError: if the clip shows the future or has too few frames.
        """
        planes, actions = self._see(clip)
        latent, *_ = self._filter(planes, actions, None, sampled=False)
        return self._belief(latent, planes[:, -1], NOW)

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
            futures.append(self._decoded(latent, statics, FORECAST, T_now_ego))
        return futures

    def decode(self, belief: Belief) -> Decoded:
        """Occupancy, flow where it was learned, and the policy's action."""
        volume = belief.volume.permute(0, 2, 3, 4, 1)
        logit = self.occupancy(volume)[..., 0].float()
        flow = None if self.flow is None else self.flow(volume).permute(0, 4, 1, 2, 3).float()
        action = None if belief.state is None else self.states.action(self._unpacked(belief.state))
        return Decoded(occupancy_logit=logit, feature=belief.volume, flow=flow, action=action)

    def unroll(self, clip: Clip, steps: int, generator: torch.Generator | None) -> Unrolled:
        """All that training looks at: T observed frames by the posterior, `steps` imagined by the prior.

        States are sampled with a generator; statics are those of a random frame then (§3.1).
        """
        planes, actions = self._see(clip)
        sampled = generator is not None
        latent, latents, posteriors, priors = self._filter(planes, actions, generator, sampled=sampled)
        frames = planes.shape[1]
        shown = int(torch.randint(frames, (1,), generator=generator)) if sampled else frames - 1
        statics = self._statics(planes[:, shown])
        beliefs = [self._decoded(each, statics, NOW, None) for each in latents]
        policy = [self.states.action(each) for each in latents]
        for _ in range(steps):
            latent, prior = self._ahead(latent, policy[-1])
            latent = _with_state(latent, prior.sample(generator) if sampled else prior.mean)
            beliefs.append(self._decoded(latent, statics, FORECAST, None))
            policy.append(self.states.action(latent))
        return Unrolled(
            beliefs=tuple(beliefs),
            posteriors=tuple(posteriors),
            priors=tuple(priors),
            actions=torch.stack(policy, dim=1),
            velocities_mps=torch.stack([self.states.velocities_mps(each.state) for each in latents], dim=1),
        )

    def _see(self, clip: Clip) -> tuple[Float[Tensor, "b T C Y X"], Float[Tensor, "b T 2"]]:
        """Planes of the observed frames, and what was done at each but the last (zeros there)."""
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
        return planes, actions_of(seen)

    def _filter(
        self,
        planes: Float[Tensor, "b T C Y X"],
        actions: Float[Tensor, "b T 2"],
        generator: torch.Generator | None,
        *,
        sampled: bool,
    ) -> tuple[Latent, list[Latent], list[DiagonalGaussian], list[DiagonalGaussian]]:
        """Posterior and prior at each observed frame; the first prior is N(0, I)."""
        b, frames = planes.shape[:2]
        seen = self.to_vector(planes.flatten(0, 1)).unflatten(0, (b, frames))
        latent = self.states.begin(b, planes.device)
        latents, posteriors, priors = [], [], []
        for t in range(frames):
            if t == 0:
                prior = DiagonalGaussian.standard(latent.state)
                last = torch.zeros_like(actions[:, 0])
            else:
                last = actions[:, t - 1]
                predicted = self.states.action(latent)
                latent, prior = self._ahead(latent, predicted)
            posterior = self.states.posterior(latent, last, seen[:, t])
            latent = _with_state(latent, posterior.sample(generator) if sampled else posterior.mean)
            latents.append(latent)
            posteriors.append(posterior)
            priors.append(prior)
        return latent, latents, posteriors, priors

    def _ahead(self, latent: Latent, action: Float[Tensor, "b 2"]) -> tuple[Latent, DiagonalGaussian]:
        """One key frame on: the new history, and what state to expect there."""
        dt_s = torch.full_like(latent.history[:, 0], self.dt_s)
        latent = self.states.transition(latent, dt_s)
        return latent, self.states.prior(latent, action)

    def _statics(self, plane: Float[Tensor, "b C Y X"]) -> Float[Tensor, "b _S Y X"]:
        """b̂; no channels without Static Scene Propagation."""
        return plane[:, :0] if self.statics is None else self.statics(plane)

    def _belief(self, latent: Latent, plane: Float[Tensor, "b C Y X"], task: str) -> Belief:
        return self._decoded(latent, self._statics(plane), task, None)

    def _decoded(
        self,
        latent: Latent,
        statics: Float[Tensor, "b _S Y X"],
        task: str,
        T_now_ego: Float[Tensor, "b 4 4"] | None,
    ) -> Belief:
        """m_θ and l_θ: the volume of features of a state."""
        history = latent.history if self.states.recall is None else self.states.recall(latent)
        planes = [self.from_vector(torch.cat([history, latent.state], dim=-1)), statics]
        if self.prompt is not None:
            planes.append(self.prompt(task, len(statics)))
        volume = self.to_volume(torch.cat(planes, dim=1))
        return Belief(volume=volume, state=_packed(latent), statics=statics, T_now_ego=T_now_ego)

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


def actions_of(clip: Clip) -> Float[Tensor, "b T 2"]:
    """What was done at each frame up to the next: velocity, m/s, and the bicycle's steering angle, rad.

    The angle is that of the arc between two poses; 0 at the last frame, where it is not known, and while
    the vehicle hardly moves.
    """
    T = clip.T_world_ego
    T_step = inverse_se3(T[:, :-1]) @ T[:, 1:]
    way_m = T_step[..., :2, 3].norm(dim=-1)
    dt_s = torch.diff(clip.t_s, dim=1).to(way_m)
    speed = torch.where(clip.ego_speed_valid[:, :-1], clip.ego_speed_mps[:, :-1].to(way_m), way_m / dt_s)
    curvature = yaw_of(T_step) / way_m.clamp_min(1e-3)
    steering = torch.where(way_m > SLOW_MPS * dt_s, torch.atan(WHEELBASE_M * curvature), 0.0)
    done = torch.stack([speed, steering], dim=-1).float()
    return torch.cat([done, torch.zeros_like(done[:, :1])], dim=1)


def motion_of(action: Float[Tensor, "b 2"], dt_s: float) -> Float[Tensor, "b 4 4"]:
    """The ego frame after an action, in that before it: the bicycle's arc."""
    speed, steering = action.unbind(-1)
    way_m, curvature = speed * dt_s, torch.tan(steering) / WHEELBASE_M
    yaw = way_m * curvature
    cos, sin = yaw.cos(), yaw.sin()
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    chord = way_m * torch.sinc(0.5 * yaw / math.pi)
    x, y = chord * (0.5 * yaw).cos(), chord * (0.5 * yaw).sin()
    rows = [[cos, -sin, zero, x], [sin, cos, zero, y], [zero, zero, one, zero], [zero, zero, zero, one]]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
