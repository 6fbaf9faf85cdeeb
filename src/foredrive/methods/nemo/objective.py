"""NeMo's two training objectives (eq. 9–11 and 15)."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.data.augmentation import AugmentConfig, augmented
from foredrive.engine.loop import Schedule
from foredrive.heads.joint import TaskTerms
from foredrive.heads.occupancy_losses import motion_emphasis, occupancy_loss
from foredrive.heads.plan_losses import ego_motion_loss, waypoint_loss
from foredrive.methods.blocks.losses import ImageFeatures, l1_loss, perceptual_loss
from foredrive.methods.blocks.training_rays import averaged_rays, thinned_rays
from foredrive.methods.nemo.sampling import ImaginationSampler, ImaginationSampling
from foredrive.methods.nemo.world_model import Nemo
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.planner import set_planner_trainable
from foredrive.ops.masked import masked_mean
from foredrive.scene import Belief, Clip, Decoded, Example


@dataclass(frozen=True)
class NemoWeights:
    """The λ of NeMo. The paper: recon 0.5, occ 0.5, wpts 1 in fine-tuning; scal 10, BCE 1; perc not given.

    In pre-training `wpts` is 0 and the planner is not trained.
    """

    wpts: float
    """λ_wpts: weight of the distance between planned and driven waypoints (eq. 14)."""
    recon: float
    """λ_recon: weight of the reconstruction of images, L1 of colours and the perceptual loss (eq. 9)."""
    occ: float
    """λ_occ: weight of the occupancy loss (eq. 10-11)."""
    scal: float = 10.0
    """λ_scal: weight of the scene-class affinity within the occupancy loss (eq. 11)."""
    bce: float = 1.0
    """λ_BCE: weight of the binary cross-entropy within the occupancy loss (eq. 11)."""
    perc: float = 0.1
    """Weight of the perceptual loss within the reconstruction (eq. 9)."""
    occupied: float = 1.0
    """Weight of occupied voxels within the BCE. Above the road, only a few percent are occupied."""
    moving: float = 1.0
    """Weight within the BCE of voxels that move and of those next to them. The paper weighs all equally."""
    future: float = 1.0
    """Weight of each imagined key frame relative to now. The paper weighs all equally."""
    ego: float = 0.0
    """Weight of the error of the predicted ego motion against the driven path. The paper has no such loss:
    its ego motion is learned through the imagined frames alone."""
    flow: float = 0.0
    """Weight of the error of the predicted flow, m/s, where labels know it. The paper has no such loss: its
    flow is learned through the imagined frames alone. `moving` weighs here too."""
    over_frames: Literal["mean", "sum"] = "mean"
    """Reduction of `recon` and `occ` over now and the imagined frames. Eq. 9 and 10 sum, so with T_f = 3 a
    mean has a quarter of their weight beside `wpts`. Over voxels and pixels both take the mean."""


@dataclass(frozen=True)
class NemoStage:
    """One stage of NeMo's training."""

    schedule: Schedule
    weights: NemoWeights
    ray_stride: int
    """One ray in `ray_stride` pixels along rows and columns is rendered."""
    pixels: Literal["thinned", "averaged"] = "thinned"
    """Truth of a ray: its own pixel, or the mean of the `ray_stride`² pixels around it."""
    perceptual: str | None = None
    """Network of the perceptual loss: "vgg16" (its weights are downloaded), a file of VGG-16 weights, or
    "tower", the image tower that comes with the package; None disables that loss (weight 0)."""
    imagine: bool = True
    """Imagine the future key frames and supervise them. If False, only the present is trained."""
    imagined: ImaginationSampling = field(default_factory=ImaginationSampling)
    """The part of a step that is imagined."""
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    """Augmentation of the examples. The paper has none."""
    kind: Literal["nemo"] = "nemo"


class NemoObjective(nn.Module):
    """The mapping from a batch to its losses. It is the trained module, so that DDP sees one forward pass.

    Args:
        agent: world model and planner.
        stage: λ, and what is trained.
        steps: T_f, number of future key frames that are imagined and supervised, if the stage imagines.
        image_features: trained features for the perceptual loss, or None to disable it.
        tasks: losses of the agent's heads, or None if they are not trained.

    Raises:
        InputError: what is imagined does not fit, as `ImaginationSampler` says.
    """

    def __init__(
        self,
        agent: PlanningAgent[Nemo],
        stage: NemoStage,
        *,
        steps: int,
        image_features: ImageFeatures | None = None,
        tasks: TaskTerms | None = None,
    ) -> None:
        super().__init__()
        self.agent, self.stage, self.weights = agent, stage, stage.weights
        self.rays = averaged_rays if stage.pixels == "averaged" else thinned_rays
        self.steps = steps if stage.imagine else 0
        self.image_features, self.tasks = image_features, tasks
        world, weights = agent.world_model, stage.weights
        plans = weights.wpts > 0
        # The planner learns only if its loss counts
        set_planner_trainable(agent.planner, plans)
        self.sampler = ImaginationSampler(agent, stage.imagined, looks_back=tasks is not None, plans=plans)
        imagines = self.steps > 0 or (plans and agent.planner.imagined_frames > 0)
        for parameter in world.imagination():
            parameter.requires_grad_(imagines)
        # Occupancy gets gradients from its own loss and, as alpha, from rendering
        world.occupancy.requires_grad_(weights.occ > 0 or weights.recon > 0)
        world.renderer.requires_grad_(weights.recon > 0)

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. The generator augments and picks rays and samples."""
        frames = 1 if self.tasks is None else self.tasks.config.heads.frames
        # Augmentation is the same for all frames of an example
        example = augmented(example, self.stage.augment, generator, frames)
        clip, world = example.clip, self.agent.world_model
        now, weights = clip.now, self.weights
        observed = clip.observed()
        needed = self.agent.planner.imagined_frames if weights.wpts > 0 else 0
        # Imagine at least as far as the planner reads, also in steps that train the present alone
        steps = self.steps if self.sampler.imagines_now() else 0
        beliefs = self.sampler.rollout(observed, max(steps, needed))
        output = None if self.tasks is None else self.agent.perceive(beliefs[0], clip, instances=True)
        decoded = [world.decode(belief) for belief in beliefs[: steps + 1]]

        losses = {name: clip.t_s.new_zeros(()) for name in ("l1", "perc", "occ")}
        flow_errors = []
        # Relative weight of now and of each imagined frame
        shares = clip.t_s.new_tensor([1.0] + [weights.future] * (len(decoded) - 1))
        shares = shares / shares.sum() if weights.over_frames == "mean" else shares
        for k, (belief, share) in enumerate(zip(decoded, shares, strict=True)):
            # Imagined beliefs may hold only the first items of the batch
            frame, items = now + k, slice(len(belief.occupancy_logit))
            flow, flow_known = example.flow.values[items, frame], example.flow.known[items, frame]
            emphasis: Tensor | float = 1.0
            if weights.moving != 1:
                emphasis = motion_emphasis(flow, flow_known, weights.moving)
            if weights.flow > 0 and belief.flow is not None:
                # Velocity of each imagined frame against the labels of the same frame; now has none
                error = (belief.flow - flow).norm(dim=1)
                flow_errors.append(masked_mean(emphasis * error, flow_known))
            if weights.occ > 0:
                # Occupancy of each frame against the labels of the same frame (eq. 10)
                losses["occ"] = losses["occ"] + share * occupancy_loss(
                    belief.occupancy_logit,
                    example.occupancy.values[items, frame, 0],
                    example.occupancy.known[items, frame],
                    scal_weight=weights.scal,
                    bce_weight=weights.bce,
                    occupied_weight=weights.occupied,
                    emphasis=emphasis,
                )
            if weights.recon > 0:
                for name, error in self._colour_errors(belief, clip[items], frame, generator).items():
                    losses[name] = losses[name] + share * error

        losses["loss"] = weights.occ * losses["occ"] + weights.recon * (
            losses["l1"] + weights.perc * losses["perc"]
        )
        if flow_errors:
            losses["flow"] = torch.stack(flow_errors).mean()
            losses["loss"] = losses["loss"] + weights.flow * losses["flow"]
        if weights.ego > 0 and steps > 0:
            losses["ego"] = self._ego_error(clip, beliefs[1 : steps + 1])
            losses["loss"] = losses["loss"] + weights.ego * losses["ego"]
        # A step without imagination still needs gradients of all trained parameters for DDP
        if len(beliefs) == 1 and self.steps > 0:
            losses["loss"] = losses["loss"] + self.sampler.no_change()
        if weights.wpts > 0:
            plan = self.agent.plan(observed, beliefs, output)
            losses["wpts"] = waypoint_loss(plan, example.clip.future)
            losses["loss"] = losses["loss"] + weights.wpts * losses["wpts"]
        if self.tasks is not None and output is not None:
            losses |= self.tasks(output, example)
            losses["loss"] = losses["loss"] + losses["tasks"]
        return losses

    def _colour_errors(
        self, belief: Decoded, clip: Clip, frame: int, generator: torch.Generator
    ) -> dict[str, Float[Tensor, ""]]:
        """Return the errors of the colour along rays of a frame against its images (eq. 9)."""
        rays = self.rays(clip, frame, self.stage.ray_stride, generator)
        rendered = self.agent.world_model.renderer(
            belief.feature, belief.occupancy_logit, rays.origin, rays.direction, generator
        )
        b, c, _, h, w = rays.rgb.shape
        predicted = rendered.rgb.view(b * c, h, w, 3).permute(0, 3, 1, 2)
        # Images that are missing are masked in both losses
        truth, valid = rays.rgb.flatten(0, 1), rays.valid.flatten()
        errors = {"l1": l1_loss(predicted, truth, valid)}
        if self.image_features is not None:
            errors["perc"] = perceptual_loss(predicted, truth, valid, self.image_features)
        return errors

    def _ego_error(self, clip: Clip, futures: list[Belief]) -> Float[Tensor, ""]:
        """Return the mean error of the predicted ego motions, m."""
        spec, driven = self.agent.world_model.spec, clip.T_world_ego[:, clip.now :]
        errors = []
        for k, future in enumerate(futures, start=1):
            assert future.T_now_ego is not None
            items = len(future.T_now_ego)
            errors.append(ego_motion_loss(future.T_now_ego, driven[:items, 0], driven[:items, k], spec))
        return torch.stack(errors).mean()
