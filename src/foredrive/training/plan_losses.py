"""The loss of an agent's plan: of the waypoints that it regresses, or of the plans that it scores."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from foredrive.losses import waypoint_loss
from foredrive.losses.plan_scores import soft_imitation_loss, sub_score_loss
from foredrive.models.agent import PlanningAgent
from foredrive.models.plan_scorer import SUB_SCORES
from foredrive.models.plan_vocabulary import Candidates
from foredrive.models.tasks.heads import HeadOutput
from foredrive.scene import Belief, Clip, Example
from foredrive.training.plan_labels import plan_labels


def plan_losses(
    agent: PlanningAgent[Any],
    observed: Clip,
    beliefs: Sequence[Belief],
    found: HeadOutput | None,
    example: Example,
) -> dict[str, Float[Tensor, ""]]:
    """Return the loss of the plan as "wpts". A scorer also has its parts, as "score_NAME".

    Args:
        observed: the clip up to now.
        beliefs: about now and the key frames that the planner reads.
        found: output of the agent's heads.
        example: with the driven future, or the expert's, and what plans are scored by.

    Raises:
        InputError: the example lacks the truth that plans are scored by.
    """
    future = example.clip.future
    if agent.planner.scorer is None:
        return {"wpts": waypoint_loss(agent.plan(observed, beliefs, found), future)}
    plans = agent.score(observed, beliefs, found)
    labels = plan_labels(Candidates(plans.xy, plans.yaw, plans.speed_mps), example, plans.dt_s)
    parts = sub_score_loss(plans.logits, labels.values, labels.known)
    imitation = soft_imitation_loss(plans.imitation, plans.xy, future.xy[:, 0], future.valid[:, 0])
    named = {f"score_{name}": part for name, part in zip(SUB_SCORES, parts, strict=True)}
    return {"wpts": parts.sum() + imitation, "score_imitation": imitation} | named
