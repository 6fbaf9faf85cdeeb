"""A small probabilistic detection head after DETR: from a volume to a set of boxes with uncertainties."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.heads.plane import PlaneFeatures, cell_middles
from foredrive.scene import Detections, VoxelSpec
from foredrive.scene.record import Record
from foredrive.sets import BoxDensity, Family, MultiBernoulli

LOG_STD_RANGE = (-4.0, 2.0)
"""Bounds of the log standard deviations: 2 cm to 7 m for positions; log sizes and headings use the same
numbers."""
TYPICAL_LOG_LWH = (1.2, 0.4, 0.4)


@dataclass(frozen=True)
class BoxSet(Record):
    """The raw output of the head for each query; `detections` and `as_multi_bernoulli` return densities."""

    logits: Float[Tensor, "*b Q K_1"]
    """Logits of the classes and, last, of "no object"."""
    mean: Float[Tensor, "*b Q 6"]
    """Centre (ego frame, m) and log of length, width and height (m)."""
    log_std: Float[Tensor, "*b Q 6"]
    heading: Float[Tensor, "*b Q 2"]
    """Sine and cosine of the yaw, normalised to length 1."""
    log_std_yaw: Float[Tensor, "*b Q"]
    family: Family = "gaussian"
    """Family of the density of `mean` with `log_std`; the heading has a von Mises density."""

    def as_multi_bernoulli(self) -> MultiBernoulli:
        """Return the boxes as a random finite set.

        It is built from logits, so no precision is lost where r is close to 1.
        """
        boxes = BoxDensity(
            mean=self.mean,
            chol=torch.diag_embed(self.log_std.exp()),
            yaw=torch.atan2(self.heading[..., 0], self.heading[..., 1]),
            concentration=(-2 * self.log_std_yaw).exp(),
            family=self.family,
        )
        return MultiBernoulli.from_softmax(self.logits, boxes)

    def detections(self) -> Detections:
        """Return the boxes as `Detections`, which hold mean and covariance but no family.

        The existence is that of the logits, also where a loss taught odds that are too high
        (`AgentSet.best_class`). Sine and cosine get the variance of the angle.
        """
        log_prob = self.logits.double().log_softmax(-1)
        # Probability that the query is any object
        log_existence = log_prob[..., :-1].logsumexp(-1)
        # Sine and cosine both take the spread of the angle
        std_yaw = self.log_std_yaw[..., None].expand(*self.log_std_yaw.shape, 2)
        std = torch.cat([self.log_std, std_yaw], dim=-1).exp()
        return Detections(
            existence=log_existence.exp(),
            log_class=log_prob[..., :-1] - log_existence[..., None],
            mean=torch.cat([self.mean, self.heading], dim=-1),
            chol=torch.diag_embed(std),
            valid=torch.ones_like(self.log_std_yaw, dtype=torch.bool),
        )


class DetectionHead(nn.Module):
    """A head from a volume to a set of boxes.

    Height is folded into the channels. Convolutions shrink the plane until each cell is one query. Queries
    attend to each other, so that one can claim an object and the others stay empty. Each query predicts a box
    relative to the centre of its cell, its class, and its uncertainty.

    Args:
        spec: grid of the volume.
        channels: D of the volume.
        classes: K.
        width: channels of the queries.
        shrink: how many times the plane is halved.
        layers, heads: sizes of the attention among queries.
        family: family of the box densities, which the likelihoods of training and evaluation use.
    """

    middle_m: Tensor

    def __init__(
        self,
        spec: VoxelSpec,
        *,
        channels: int,
        classes: int,
        width: int = 64,
        shrink: int = 2,
        layers: int = 2,
        heads: int = 4,
        family: Family = "gaussian",
    ) -> None:
        super().__init__()
        self.family = family
        self.classes = classes
        self.plane = PlaneFeatures(spec, channels=channels, width=width, shrink=shrink)
        middle = cell_middles(self.plane.lower_m, self.plane.cell_m, self.plane.shape_yx)
        self.register_buffer("middle_m", middle, persistent=False)
        self.place = nn.Parameter(0.02 * torch.randn(len(middle), width))
        layer = nn.TransformerEncoderLayer(
            width, heads, 2 * width, dropout=0.0, batch_first=True, norm_first=True
        )
        self.attention = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, classes + 1 + 6 + 2 + 7))
        final = self.out[1]
        assert isinstance(final, nn.Linear)
        with torch.no_grad():  # start with a low probability of existence
            final.bias[classes] = 4.0

    def forward(self, volume: Float[Tensor, "b D Z Y X"]) -> BoxSet:
        """Return the boxes of all queries."""
        plane = self.plane(volume)
        queries = self.attention(plane.cells + self.place)
        logits, shift, size, heading, log_std = self.out(queries).split(
            [self.classes + 1, 3, 3, 2, 7], dim=-1
        )
        # Positions relative to the cell in units of its edge; height relative to the ego frame
        ground = self.middle_m + plane.cell_m * shift[..., :2]
        # Sizes relative to a typical object
        log_lwh = size + size.new_tensor(TYPICAL_LOG_LWH)
        log_std = log_std.clamp(*LOG_STD_RANGE)
        return BoxSet(
            logits=logits,
            mean=torch.cat([ground, shift[..., 2:], log_lwh], dim=-1),
            log_std=log_std[..., :6],
            heading=nn.functional.normalize(heading, dim=-1, eps=1e-3),
            log_std_yaw=log_std[..., 6],
            family=self.family,
        )
