"""NeMo's two training objectives (eq. 9–11 and 15)."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.data.augmentation import AugmentConfig, augmented
from foredrive.engine.loop import Schedule
from foredrive.errors import InputError
from foredrive.methods.blocks.lifting import lift_frames
from foredrive.methods.blocks.losses import ImageFeatures, l1_loss, perceptual_loss
from foredrive.methods.blocks.training_rays import averaged_rays, thinned_rays
from foredrive.methods.nemo import Nemo
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.methods.planner.planner import set_planner_trainable
from foredrive.scene import Belief, Clip, Example, last_frames
from foredrive.tasks.heads.joint import TaskTerms
from foredrive.tasks.occupancy.losses import occupancy_loss
from foredrive.tasks.planning.losses import ego_motion_loss, waypoint_loss


@dataclass(frozen=True)
class NemoWeights:
    """The λ of NeMo. The paper: recon 0.5, occ 0.5, wpts 1 in fine-tuning; scal 10, BCE 1; perc not given.

    In pre-training `wpts` is 0 and the planner is not trained.
    """

    wpts: float
    recon: float
    occ: float
    scal: float = 10.0
    bce: float = 1.0
    perc: float = 0.1
    occupied: float = 1.0
    """Weight of occupied voxels within the BCE. Above the road, only a few percent are occupied."""
    future: float = 1.0
    """Weight of each imagined key frame relative to now. The paper weighs all equally."""
    ego: float = 0.0
    """Weight of the error of the predicted ego motion against the driven path. The paper has no such loss:
    its ego motion is learned through the imagined frames alone."""
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
    "tower", the image tower that comes with the package. None disables that loss (weight 0)."""
    imagine: bool = True
    """Imagine the future key frames and supervise them. If False, only the present is trained."""
    imagined_items: int | None = None
    """Number of items of each batch, or of each part of a step, that are imagined, with their pasts and
    futures. The other items train the present alone, at a fraction of the cost. None: all items, as in the
    paper."""
    imagine_every: int = 1
    """Imagine in one step of so many, from the first step on. The steps between train the present alone."""
    past_gradient: bool = True
    """Train the encoder by past frames too. Only the motion reads them."""
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
        InputError: `imagined_items` or `imagine_every` is below 1, or the planner reads imagined frames of
            items or in steps that have none.
    """

    steps_done: Tensor

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
        set_planner_trainable(agent.planner, plans)
        if stage.imagined_items is not None and stage.imagined_items < 1:
            raise InputError(f"imagined_items is {stage.imagined_items}; without any, set imagine to false")
        if stage.imagine_every < 1:
            raise InputError(f"imagine_every is {stage.imagine_every}; without any, set imagine to false")
        if plans and agent.planner.imagined_frames > 0:
            if stage.imagined_items is not None:
                raise InputError("the planner reads imagined frames of every item: leave out imagined_items")
            if stage.imagine_every > 1:
                raise InputError("the planner reads imagined frames in every step: leave out imagine_every")
        imagines = self.steps > 0 or (plans and agent.planner.imagined_frames > 0)
        if stage.imagine_every > 1:
            self.register_buffer("steps_done", torch.zeros((), dtype=torch.long))
        for parameter in world.imagination():
            parameter.requires_grad_(imagines)
        world.occupancy.requires_grad_(weights.occ > 0 or weights.recon > 0)
        world.renderer.requires_grad_(weights.recon > 0)

    def forward(self, example: Example, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        """Return losses by name; "loss" is minimised. The generator augments and picks rays and samples."""
        frames = 1 if self.tasks is None else self.tasks.config.heads.frames
        example = augmented(example, self.stage.augment, generator, frames)
        clip, world = example.clip, self.agent.world_model
        now, weights = clip.now, self.weights
        observed = clip.observed()
        needed = self.agent.planner.imagined_frames if weights.wpts > 0 else 0
        steps = self.steps if self._imagines_now() else 0
        beliefs = self._rollout(observed, max(steps, needed))
        found = None if self.tasks is None else self.agent.perceive(beliefs[0], clip)
        decoded = [world.decode(belief) for belief in beliefs[: steps + 1]]

        losses = {name: clip.t_s.new_zeros(()) for name in ("l1", "perc", "occ")}
        shares = clip.t_s.new_tensor([1.0] + [weights.future] * (len(decoded) - 1))
        shares = shares / shares.sum() if weights.over_frames == "mean" else shares
        for k, (belief, share) in enumerate(zip(decoded, shares, strict=True)):
            frame, items = now + k, slice(len(belief.occupancy_logit))
            if weights.occ > 0:
                losses["occ"] = losses["occ"] + share * occupancy_loss(
                    belief.occupancy_logit,
                    example.occupancy.values[items, frame, 0],
                    example.occupancy.known[items, frame],
                    scal_weight=weights.scal,
                    bce_weight=weights.bce,
                    occupied_weight=weights.occupied,
                )
            if weights.recon > 0:
                rays = self.rays(clip[items], frame, self.stage.ray_stride, generator)
                rendered = world.renderer(
                    belief.feature, belief.occupancy_logit, rays.origin, rays.direction, generator
                )
                b, c, _, h, w = rays.rgb.shape
                predicted = rendered.rgb.view(b * c, h, w, 3).permute(0, 3, 1, 2)
                truth, valid = rays.rgb.flatten(0, 1), rays.valid.flatten()
                losses["l1"] = losses["l1"] + share * l1_loss(predicted, truth, valid)
                if self.image_features is not None:
                    losses["perc"] = losses["perc"] + share * perceptual_loss(
                        predicted, truth, valid, self.image_features
                    )

        losses["loss"] = weights.occ * losses["occ"] + weights.recon * (
            losses["l1"] + weights.perc * losses["perc"]
        )
        if weights.ego > 0 and steps > 0:
            losses["ego"] = self._ego_error(clip, beliefs[1 : steps + 1])
            losses["loss"] = losses["loss"] + weights.ego * losses["ego"]
        if len(beliefs) == 1 and self.steps > 0:
            losses["loss"] = losses["loss"] + self._no_change()
        if weights.wpts > 0:
            plan = self.agent.plan(observed, beliefs, found)
            losses["wpts"] = waypoint_loss(plan, example.clip.future)
            losses["loss"] = losses["loss"] + weights.wpts * losses["wpts"]
        if self.tasks is not None and found is not None:
            losses |= self.tasks(found, example)
            losses["loss"] = losses["loss"] + losses["tasks"]
        return losses

    def _ego_error(self, clip: Clip, futures: list[Belief]) -> Float[Tensor, ""]:
        """Return the mean error of the predicted ego motions, m."""
        spec, driven = self.agent.world_model.spec, clip.T_world_ego[:, clip.now :]
        errors = []
        for k, future in enumerate(futures, start=1):
            assert future.T_now_ego is not None
            items = len(future.T_now_ego)
            errors.append(ego_motion_loss(future.T_now_ego, driven[:items, 0], driven[:items, k], spec))
        return torch.stack(errors).mean()

    def _imagines_now(self) -> bool:
        """Return whether this step imagines, and count it in training."""
        if self.stage.imagine_every == 1:
            return True
        now = int(self.steps_done) % self.stage.imagine_every == 0
        if self.training:
            self.steps_done += 1
        return now

    def _no_change(self) -> Float[Tensor, ""]:
        """Return 0 with a gradient of 0 for the parameters of imagination: DDP needs one in every step."""
        unused = self.agent.world_model.imagination()
        return 0.0 * torch.stack([parameter.sum() for parameter in unused]).sum()

    def _rollout(self, observed: Clip, steps: int) -> list[Belief]:
        """Return the beliefs about now, and about the next `steps` key frames for the imagined items."""
        stage, world = self.stage, self.agent.world_model
        if stage.imagined_items is None and stage.past_gradient:
            return self.agent.rollout(observed, steps)
        looks_back = self.tasks is not None  # heads read the past of all items
        items = slice(None if looks_back else stage.imagined_items)
        frames = last_frames(observed, world.past_frames if steps or looks_back else 0)
        present, _ = lift_frames(frames[:, -1:], world.backbone, world.encoder)
        now = Belief(volume=present[:, -1])
        if steps == 0 and not looks_back:
            return [now]
        with torch.set_grad_enabled(stage.past_gradient and torch.is_grad_enabled()):
            past, _ = lift_frames(frames[items, :-1], world.backbone, world.encoder)
        history = torch.cat([past, present[items]], dim=1)
        believed = world.believe(frames[items], history)
        imagined = world.imagine(believed, steps) if steps else []
        return [believed if looks_back else now, *imagined]
