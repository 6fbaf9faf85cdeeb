"""A driving agent: a world model with a planner on top."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.geometry.precision import full_precision
from foredrive.heads.carried import CarriedAgents
from foredrive.heads.heads import HeadOutput, TaskHeads, volumes_of
from foredrive.methods.planner.ego_mlp import ego_motion, route_target
from foredrive.methods.planner.planner import VolumePlanner
from foredrive.scene import Belief, Clip, Decoded, Trajectory, WorldModel

W = TypeVar("W", bound=WorldModel)


class AgentOutput(NamedTuple):
    """The output of an agent for one clip."""

    beliefs: list[Belief]
    """The belief about now, then those of the imagined key frames."""
    decoded: list[Decoded]
    plan: Trajectory
    perceived: HeadOutput | None = None
    """Output of the agent's own task heads."""


class PlanningAgent(nn.Module, Generic[W]):
    """An `Agent` over any world model. It plans from the volumes at now and at the next step (NeMo §3.3).

    Args:
        world_model: any world model.
        planner: reads its volumes and, if it attends to them, the output of `heads`.
        heads: task heads that were trained with the agent, or that its planner attends to.
    """

    def __init__(self, world_model: W, planner: VolumePlanner, heads: TaskHeads | None = None) -> None:
        super().__init__()
        self.world_model: W = world_model
        self.planner = planner
        self.heads = heads
        self._kept: tuple[nn.Module, ...] = ()

    def keep(self, *parts: nn.Module) -> None:
        """Keep the weights of some of its modules, and the statistics of their norms, as they are."""
        self._kept = (*self._kept, *(part.requires_grad_(False).eval() for part in parts))

    def train(self, mode: bool = True) -> "PlanningAgent[W]":
        """Set the mode of all modules but those that are kept."""
        super().train(mode)
        for part in self._kept:
            part.eval()
        return self

    def forward(self, clip: Clip, steps: int) -> AgentOutput:
        """Observe the clip, imagine `steps` key frames (and those the planner needs), and plan."""
        beliefs = self.rollout(clip, max(steps, self.planner.imagined_frames))
        decoded = [self.world_model.decode(belief) for belief in beliefs[: steps + 1]]
        output = self.perceive(beliefs[0])
        return AgentOutput(beliefs[: steps + 1], decoded, self.plan(clip, beliefs, output), output)

    def rollout(self, clip: Clip, steps: int) -> list[Belief]:
        """Return the beliefs about now and about the next `steps` key frames."""
        now = self.world_model.observe(clip)
        return [now, *self.world_model.imagine(now, steps)] if steps else [now]

    def perceive(
        self, now: Belief, sequences: Clip | None = None, *, instances: bool = False
    ) -> HeadOutput | None:
        """Return the output of the agent's task heads for a belief about now; None without heads.

        Args:
            now: belief about now.
            sequences: the clips, if they are the sequences in which heads that carry agents on are trained.
            instances: imagine the key frames in which the head of instances finds vehicles. No planner reads
                its output, so it is asked in training alone.
        """
        return None if self.heads is None else self.perceived(now, sequences, instances=instances)

    def perceived(
        self,
        now: Belief,
        sequences: Clip | None = None,
        carried: CarriedAgents | None = None,
        *,
        instances: bool = False,
    ) -> HeadOutput:
        """Return the output of the task heads of an agent that has some.

        Heads compute in 32 bits, because positions in 16 are off by tenths of a cell.

        Args:
            now: belief about now.
            sequences: as for `perceive`.
            carried: agents of the frame before, for heads that carry agents on.
            instances: as for `perceive`.
        """
        assert self.heads is not None
        config, steps = self.heads.config, None
        if sequences is not None:
            # Heads that carry agents from frame to frame need the ego motion between the frames
            steps = config.steps(sequences.T_world_ego[:, sequences.now])
        read = volumes_of(self.world_model, now, config.volumes, config.later if instances else 0)
        # Tasks that read one volume share its cast, so it is converted once
        with full_precision(now.volume):
            cast = {id(volume): volume.map_tensors(Tensor.float) for volume in read.values()}
            volumes = {task: cast[id(volume)] for task, volume in read.items()}
            output: HeadOutput = self.heads(volumes, steps, carried)
        return output

    def tokens(self, now: Belief, output: HeadOutput | None = None) -> Float[Tensor, "b N C"] | None:
        """Return what the planner attends to beside the volumes; None if it does not.

        Args:
            now: belief about now.
            output: output of `perceive`, if it is known.
        """
        if self.planner.scene is None:
            return None
        output = output or self.perceive(now)
        assert output is not None
        tokens: Tensor = self.planner.scene(output)
        return tokens

    def plan(self, clip: Clip, beliefs: Sequence[Belief], output: HeadOutput | None = None) -> Trajectory:
        """Plan from the belief about now and those next key frames that the planner uses.

        Args:
            clip: for the motion of the ego vehicle, the command and the route.
            beliefs: about now and about the next key frames.
            output: output of `perceive`, if it is known.
        """
        plan: Trajectory = self.planner(*self._planner_inputs(clip, beliefs, output))
        return plan

    def _planner_inputs(
        self, clip: Clip, beliefs: Sequence[Belief], output: HeadOutput | None
    ) -> tuple[Any, ...]:
        """Return the arguments of the planner."""
        poses, speeds = ego_motion(clip, self.planner.history)
        return (
            self.planner_volume(beliefs[0]),
            self.planner_volume(beliefs[1]) if self.planner.imagined_frames else None,
            clip.command,
            clip.command_valid,
            speeds[:, -1],
            clip.ego_speed_valid[:, clip.now],
            torch.cat([poses, speeds[:, :-1, None]], dim=-1),
            route_target(clip) if self.planner.target else None,
            self.tokens(beliefs[0], output),
        )

    def planner_volume(self, belief: Belief) -> Float[Tensor, "b D Z Y X"]:
        """Return the volume that the planner reads."""
        return self.world_model.volume_for(belief, "planning")

    @torch.no_grad()
    def act(self, observation: Clip) -> Trajectory:
        """Return the plan from now on."""
        return self.plan(observation, self.rollout(observation, self.planner.imagined_frames))
