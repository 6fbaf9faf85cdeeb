"""NeMo under evaluation: what it says about a clip, in the form an evaluation asks for."""

import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.evaluation.predictor import Prediction
from foredrive.models.nemo import NemoAgent
from foredrive.scene import Clip, Decoded
from foredrive.training import thinned_rays


class NemoPredictor:
    """A trained agent as a `Predictor`.

    Args:
        agent: in evaluation mode.
        steps: number of future key frames to predict.
        ray_stride: one pixel in `ray_stride` along rows and columns is rendered, at now; 0 renders nothing.
    """

    def __init__(self, agent: NemoAgent, steps: int, ray_stride: int) -> None:
        self.agent, self.steps, self.ray_stride = agent, steps, ray_stride

    @torch.no_grad()
    def predict(self, observed: Clip) -> Prediction:
        """Occupancy now and at the next key frames, the plan, the views at now."""
        output = self.agent(observed, self.steps)
        decoded = output.decoded
        return Prediction(
            occupancy_logit=torch.stack([frame.occupancy_logit for frame in decoded], dim=1),
            plan=output.plan,
            images=self._views(observed, decoded[0])[:, None] if self.ray_stride else None,
            image_stride=max(self.ray_stride, 1),
        )

    def _views(self, observed: Clip, now: Decoded) -> Float[Tensor, "b C 3 h w"]:
        rays = thinned_rays(observed, observed.now, self.ray_stride)
        rendered = self.agent.world_model.renderer(
            now.feature, now.occupancy_logit, rays.origin, rays.direction
        )
        b, c, _, h, w = rays.rgb.shape
        return rendered.rgb.view(b, c, h, w, 3).permute(0, 1, 4, 2, 3)
