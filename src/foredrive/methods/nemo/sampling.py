"""Draws the part of a training step that is imagined: every frame of every item costs too much."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.errors import InputError
from foredrive.methods.blocks.lifting import lift_frames
from foredrive.methods.nemo.world_model import Nemo
from foredrive.methods.planner.agent import PlanningAgent
from foredrive.scene import Belief, Clip, last_frames


@dataclass(frozen=True)
class ImaginationSampling:
    """The part of a step that is imagined. By default all of it, as in the paper."""

    items: int | None = None
    """Number of items of each batch, or of each part of a step, that are imagined, with their pasts and
    futures; None: all items. The other items train the present alone, at a fraction of the cost."""
    every: int = 1
    """Imagine in one step of so many, from the first step on. The steps between train the present alone."""
    past_gradient: bool = True
    """Train the encoder by past frames too. Only the motion reads them."""


class ImaginationSampler(nn.Module):
    """Rolls out the sampled part of each batch. It counts the steps of training, also over interruptions.

    Args:
        agent: world model and planner.
        config: what is imagined.
        looks_back: whether the past of all items is read, as task heads do.
        plans: whether the planner is trained.

    Raises:
        InputError: a number is below 1, or the planner reads imagined frames of items or steps without any.
    """

    steps_done: Tensor

    def __init__(
        self, agent: PlanningAgent[Nemo], config: ImaginationSampling, *, looks_back: bool, plans: bool
    ) -> None:
        super().__init__()
        for name, number in (("items", config.items), ("every", config.every)):
            if number is not None and number < 1:
                raise InputError(f"imagined.{name} is {number}; without any, set imagine to false")
        if plans and agent.planner.imagined_frames > 0:
            if config.items is not None:
                raise InputError("the planner reads imagined frames of every item: leave out imagined.items")
            if config.every > 1:
                raise InputError("the planner reads imagined frames in every step: leave out imagined.every")
        self._agent = (agent,)  # in a tuple, so that its weights are not this module's
        self.config, self.looks_back = config, looks_back
        if config.every > 1:
            self.register_buffer("steps_done", torch.zeros((), dtype=torch.long))

    def imagines_now(self) -> bool:
        """Return whether this step imagines, and count it in training."""
        if self.config.every == 1:
            return True
        # The first step imagines, then every `every`-th one
        now = int(self.steps_done) % self.config.every == 0
        if self.training:
            self.steps_done += 1
        return now

    def rollout(self, observed: Clip, steps: int) -> list[Belief]:
        """Return the beliefs about now, and about the next `steps` key frames for the imagined items."""
        (agent,) = self._agent
        config, world = self.config, agent.world_model
        if config.items is None and config.past_gradient:
            return agent.rollout(observed, steps)
        # The past of the items that are not imagined is read only by task heads
        items = slice(None if self.looks_back else config.items)
        # The present of all items has gradients; past frames only where something reads them.
        frames = last_frames(observed, world.past_frames if steps or self.looks_back else 0)
        present, _ = lift_frames(frames[:, -1:], world.backbone, world.encoder)
        now = Belief(volume=present[:, -1])
        if steps == 0 and not self.looks_back:
            return [now]
        with torch.set_grad_enabled(config.past_gradient and torch.is_grad_enabled()):
            # Past frames are encoded apart, without gradients if the motion alone reads them
            past, _ = lift_frames(frames[items, :-1], world.backbone, world.encoder)
        # History of the imagined items: past volumes, then the present one with its gradients
        history = torch.cat([past, present[items]], dim=1)
        believed = world.believe(frames[items], history)
        imagined = world.imagine(believed, steps) if steps else []
        # Heads need the history of the belief; the planner and the decoder need the volume of all items
        return [believed if self.looks_back else now, *imagined]

    def no_change(self) -> Float[Tensor, ""]:
        """Return 0 with a gradient of 0 for the parameters of imagination: DDP needs one in every step."""
        (agent,) = self._agent
        return 0.0 * torch.stack([parameter.sum() for parameter in agent.world_model.imagination()]).sum()
