"""NeMo's motion flow module: flow of the scene and motion of the ego vehicle (§3.2, eq. 7–8)."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.geometry.se3 import exp_se3


@dataclass(frozen=True)
class MotionConfig:
    """Sizes of a `MotionFlow`."""

    hidden: int
    """Channels of the ConvNets. Those of the SE(3) head double at each of its two steps."""
    pool_yx: tuple[int, int] = (4, 4)
    """Size of the plane that the SE(3) head flattens. It keeps coarse positions, which rotation needs."""
    xi_scale: float = 0.1
    """Factor from outputs of the rigid head to metres and radians. It keeps early warps small."""
    ego: Literal["predicted", "measured"] = "predicted"
    """Ego motion is predicted as in the paper, or relative to going on as measured (`continued_motion`)."""
    stride: int = 1
    """Stride along y and x of the grid from which flow and ego motion are predicted. From a coarser grid than
    the volume's, the flow is interpolated. The paper has 1."""


class Motion(NamedTuple):
    """Motion over each of the next F key frames, for gathering.

    The flows of all steps lie on the grid of frame t, on which they are predicted. The content at place y
    (ego frame t) at step k + 1 was at y + flow(y) one step before.
    """

    flow: Float[Tensor, "b F 3 Z Y X"]
    """M, in metres along x, y, z of the ego frame t."""
    T_prev_next: Float[Tensor, "b F 4 4"]
    """S: the ego frame at t+k+1 -> the ego frame at t+k."""


class MotionFlow(nn.Module):
    """3-D ConvNets H (flow per voxel) and G (SE(3)) on the concatenated volumes of past and present.

    Args:
        config: sizes.
        channels: D of one volume.
        frames: number of concatenated volumes, T_p + 1.
        steps: T_f, number of future key frames.
    """

    def __init__(self, config: MotionConfig, *, channels: int, frames: int, steps: int) -> None:
        super().__init__()
        self.steps, self.xi_scale, self.stride = steps, config.xi_scale, config.stride
        wide, hidden = channels * frames, config.hidden
        to_flow = nn.Conv3d(hidden, 3 * steps, 3, padding=1)
        to_xi = nn.Linear(4 * hidden, 6 * steps)
        for parameter in (*to_flow.parameters(), *to_xi.parameters()):
            nn.init.zeros_(parameter)  # start from no motion
        # H: flow of every voxel for each step, from all volumes at full resolution
        self.flow = nn.Sequential(
            nn.Conv3d(wide, hidden, 3, padding=1),
            nn.ReLU(),
            nn.Conv3d(hidden, hidden, 3, padding=1),
            nn.ReLU(),
            to_flow,
        )
        # G: coarser volumes, pooled to a small plane, flattened and mapped to one twist per step
        self.rigid = nn.Sequential(
            nn.Conv3d(wide, hidden, 3, padding=1, stride=2),
            nn.ReLU(),
            nn.Conv3d(hidden, 2 * hidden, 3, padding=1, stride=2),
            nn.ReLU(),
            nn.AdaptiveAvgPool3d((1, *config.pool_yx)),
            nn.Flatten(),
            nn.Linear(2 * hidden * config.pool_yx[0] * config.pool_yx[1], 4 * hidden),
            nn.ReLU(),
            to_xi,
        )

    def forward(self, volumes: Float[Tensor, "b T D Z Y X"]) -> Motion:
        """Predict motion from the volumes of the past and of now (last), each in its own ego frame."""
        stacked = self._coarser(volumes.flatten(1, 2).contiguous(memory_format=torch.channels_last_3d))
        batch = len(stacked)
        if batch == 1 and stacked.device.type == "cpu" and not torch.compiler.is_compiling():
            # PyTorch uses a slow convolution for a batch of one. A batch of two takes a sixth of the time.
            stacked = stacked.expand(2, -1, -1, -1, -1)
        flow = self.flow(stacked)[:batch].float()
        if self.stride > 1:
            # Flow in metres needs no rescaling when it is interpolated
            flow = F.interpolate(flow, size=volumes.shape[-3:], mode="trilinear")
        xi = self.rigid(stacked)[:batch].float().unflatten(1, (self.steps, 6))
        # Twists are scaled down to keep early warps small, then mapped to SE(3)
        return Motion(flow=flow.unflatten(1, (self.steps, 3)), T_prev_next=exp_se3(self.xi_scale * xi))

    def _coarser(self, stacked: Float[Tensor, "b W Z Y X"]) -> Float[Tensor, "b W Z _y _x"]:
        """Average the columns of `stride` by `stride`. Layer by layer: pooling in 3-D is much slower."""
        if self.stride == 1:
            return stacked
        # Heights become items of the batch
        layers = stacked.transpose(1, 2).flatten(0, 1)
        pooled = F.avg_pool2d(layers, self.stride, ceil_mode=True, count_include_pad=False)
        return pooled.unflatten(0, (len(stacked), -1)).transpose(1, 2)
