"""Occupancy of vehicles over time under UniAD's protocol, beside detected boxes that drive on or stay."""

import numpy as np
import torch
from jaxtyping import Int
from numpy import ndarray

from foredrive.data.raster import fill_polygon
from foredrive.evaluation.metric import EvaluationContext, Figures
from foredrive.evaluation.predictor import Part, Prediction
from foredrive.geometry.boxes import box_corners
from foredrive.metrics.voxels.instances import InstanceCounts, count_rasters
from foredrive.metrics.voxels.protocols import UNIAD_INSTANCES
from foredrive.scene import Example
from foredrive.scene.agents import Agents
from foredrive.scene.boxes import VEHICLES
from foredrive.scene.map_elements import InstanceRaster

STEADY, PERSISTENCE = ".constant_velocity", ".persistence"
MIN_SCORE = 0.3
"""Score of the detections that the baselines draw, the same as that of the head's agents."""


class InstanceMetric:
    """Keys: `uniad.iou_near_pct`, `uniad.vpq_far_pct`, `….constant_velocity`, `….persistence`.

    The baselines draw the same detections as boxes, moved at their predicted velocity, or left where they
    are. Frames without annotated future are skipped, as in UniAD; those at the start of a drive count here.
    """

    name = "occupancy"
    needs: frozenset[Part] = frozenset({"instances", "agents"})

    def __init__(self, context: EvaluationContext) -> None:
        self._counts: dict[tuple[str, str], InstanceCounts] = {}
        self._frames = 0

    def update(self, prediction: Prediction, truth: Example) -> None:
        """Add b clips."""
        true = None if truth.truth is None else truth.truth.instances
        if true is None or prediction.instances is None or prediction.agents is None:
            return
        true, agents = true.to("cpu"), prediction.agents.to("cpu")
        shown = {"": prediction.instances.cpu()}
        for suffix, moves in ((STEADY, 1.0), (PERSISTENCE, 0.0)):
            drawn = [drawn_boxes(agents[item], true, moves) for item in range(len(true.valid))]
            shown[suffix] = torch.from_numpy(np.stack(drawn))
        past = UNIAD_INSTANCES.past_frames
        for suffix, raster in shown.items():
            for name, counts in count_rasters(raster, true, past, UNIAD_INSTANCES).items():
                key = (name, suffix)
                self._counts[key] = self._counts[key] + counts if key in self._counts else counts
        self._frames += int(true.valid.all(dim=1).sum())

    def result(self) -> Figures:
        """Return the figures over all frames with an annotated future."""
        out: Figures = {}
        for (name, suffix), counts in self._counts.items():
            out[f"uniad.iou_{name}_pct{suffix}"] = 100 * counts.iou
            out[f"uniad.vpq_{name}_pct{suffix}"] = 100 * counts.vpq
        return out | {"uniad.frames_counted": self._frames}


def drawn_boxes(agents: Agents, like: InstanceRaster, moves: float) -> Int[ndarray, "S Y X"]:
    """Draw unbatched vehicles as the truth is drawn, the best scored on top: number + 1 of the agent.

    Args:
        agents: detections.
        like: grid and steps of the truth.
        moves: share of the predicted velocity at which they move.
    """
    steps = like.track_id.shape[-3]
    drawn = np.zeros((steps, *like.spec.shape_yx), dtype=np.int32)
    kinds = torch.tensor(sorted(int(kind) for kind in VEHICLES))
    kept = (torch.isin(agents.category, kinds) & (agents.score >= MIN_SCORE)).nonzero()[:, 0]
    order = kept[agents.score[kept].argsort()]
    corners = box_corners(agents.centre, agents.size_lwh, agents.yaw)[:, :4, :2].double()
    for step in range(steps):
        shift = moves * step * like.dt_s * agents.velocity.double()
        for row in order.tolist():
            quad = (corners[row] + shift[row]).numpy()
            fill_polygon([quad], row + 1, like.spec, drawn[step])
    return drawn
