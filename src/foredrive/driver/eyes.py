"""Eyes of a driver: a small convolutional network on two cameras and some key frames."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from foredrive.driver.route_cells import HEIGHTS_M, route_cells, sample_cameras
from foredrive.driver.sight import RouteReader, Sight, conv_block
from foredrive.errors import InputError
from foredrive.geometry.se3 import compose_se3, inverse_se3, transform_points
from foredrive.scene import Clip

FINE, COARSE, FINE_READ = 32, 48, 16
"""Channels of the features at strides 4 and 8, and how many of the former the cells read."""
MEAN_GREY, SPREAD_GREY = 0.45, 0.25


@dataclass(frozen=True)
class CameraEyesConfig:
    """Sizes of `CameraEyes`."""

    frames: int = 2
    """Key frames that are read, now included."""
    cameras: int = 2
    blind: bool = False
    """Images are black: what the route alone tells."""
    kind: Literal["cameras"] = "cameras"


class Trunk(nn.Module):
    """Features of one camera at strides 4 and 8; the latter know those at 16 too."""

    def __init__(self) -> None:
        super().__init__()
        self.fine = nn.Sequential(conv_block(3, 16, 5), conv_block(16, FINE), conv_block(FINE, FINE, 3, 1))
        self.middle = nn.Sequential(conv_block(FINE, 64), conv_block(64, 64, 3, 1))
        self.deep = nn.Sequential(conv_block(64, 96), conv_block(96, 96, 3, 1))
        self.of_middle, self.of_deep = nn.Conv2d(64, COARSE, 1), nn.Conv2d(96, COARSE, 1)

    def forward(
        self, images: Float[Tensor, "n 3 H W"]
    ) -> tuple[Float[Tensor, "n _F _h _w"], Float[Tensor, "n _K _y _x"]]:
        """Return the features at strides 4 and 8."""
        fine = self.fine(images)
        middle = self.middle(fine)
        coarse = self.of_middle(middle)
        deep = F.interpolate(self.of_deep(self.deep(middle)), size=coarse.shape[-2:], mode="nearest")
        return fine, F.relu(coarse + deep)


def blacked(clip: Clip) -> Clip:
    """Return the clip with black images."""
    return dataclasses.replace(clip, images=torch.zeros_like(clip.images))


def seen_frames(clip: Clip, frames: int, cameras: int) -> Clip:
    """Return the last key frames of a clip, now included.

    Raises:
        InputError: the clip has another number of cameras, or fewer frames.
    """
    if clip.images.shape[2] != cameras or clip.now + 1 < frames:
        raise InputError(
            f"a driver with {cameras} cameras and {frames} key frames cannot see a clip of "
            f"{clip.images.shape[2]} cameras and {clip.now + 1} key frames"
        )
    return clip.frames(slice(clip.now + 1 - frames, clip.now + 1))


class CameraEyes(nn.Module):
    """A convolutional trunk for each camera, features sampled along the route in each key frame, two heads.

    Cells of the route are fixed in the world: in the frames before now they are read where the cameras were
    then, so that what moves differs between frames and what stands does not.

    Args:
        config: sizes.
    """

    def __init__(self, config: CameraEyesConfig) -> None:
        super().__init__()
        self.config = config
        self.trunks = nn.ModuleList([Trunk() for _ in range(config.cameras)])
        self.narrow = nn.ModuleList([nn.Conv2d(FINE, FINE_READ, 1) for _ in range(config.cameras)])
        of_frame = config.cameras * len(HEIGHTS_M) * (COARSE + FINE_READ + 1)
        self.reader = RouteReader(config.frames * of_frame, FINE + COARSE, COARSE, config.cameras)

    def forward(self, clip: Clip) -> Sight:
        """Return what is seen of the route at now.

        Raises:
            InputError: the clip has other cameras or fewer frames.
        """
        clip = blacked(clip) if self.config.blind else clip
        frames = seen_frames(clip, self.config.frames, self.config.cameras)
        fine, coarse = self._features(frames)
        wide = F.interpolate(coarse[:, -1].flatten(0, 1), size=fine.shape[-2:], mode="nearest")
        wide = wide.unflatten(0, coarse.shape[:1] + coarse.shape[2:3])
        cells = self._read(frames, route_cells(clip.route_xy, clip.route_valid), fine, coarse)
        sight: Sight = self.reader(
            clip, cells, torch.cat([fine[:, -1], wide], dim=2), coarse[:, -1].mean((-2, -1))
        )
        return sight

    def _features(
        self, frames: Clip
    ) -> tuple[Float[Tensor, "b T C _F _h _w"], Float[Tensor, "b T C _K _y _x"]]:
        """Return the features of all images at strides 4 and 8."""
        b, t = frames.images.shape[:2]
        images = (frames.images.float() / 255 - MEAN_GREY) / SPREAD_GREY
        fine, coarse = [], []
        for c, trunk in enumerate(self.trunks):
            one = images[:, :, c].flatten(0, 1).contiguous(memory_format=torch.channels_last)
            at_4, at_8 = trunk(one)
            fine.append(at_4.unflatten(0, (b, t)))
            coarse.append(at_8.unflatten(0, (b, t)))
        return torch.stack(fine, dim=2), torch.stack(coarse, dim=2)

    def _read(
        self,
        frames: Clip,
        cells: Float[Tensor, "b G L 2"],
        fine: Float[Tensor, "b T C _F _h _w"],
        coarse: Float[Tensor, "b T C _K _y _x"],
    ) -> Float[Tensor, "b _N G L"]:
        """Return the features of all frames and cameras in the cells."""
        b, count = cells.shape[0], len(HEIGHTS_M)
        z = cells.new_tensor(HEIGHTS_M)[:, None, None, None].expand(count, *cells.shape[1:3], 1)
        points = torch.cat([cells[:, None].expand(-1, count, -1, -1, -1), z.expand(b, *z.shape)], dim=-1)
        points = points.flatten(1, 3)
        # Places of now in the ego frame of each key frame: features are read where the cameras were then.
        T_frame_now = compose_se3(inverse_se3(frames.T_world_ego), frames.T_world_ego[:, -1:]).float()
        read = []
        for t in range(frames.images.shape[1]):
            moved = transform_points(T_frame_now[:, t], points)
            rig, valid = frames.rig[:, t], frames.image_valid[:, t]
            narrow = torch.stack([layer(fine[:, t, c]) for c, layer in enumerate(self.narrow)], dim=1)
            at_8 = sample_cameras(coarse[:, t], valid, rig, moved)[:, :, :-1]
            at_4 = sample_cameras(narrow, valid, rig, moved)
            both = torch.cat([at_8, at_4], dim=2)  # [b C F N]
            both = both.unflatten(-1, (count, *cells.shape[1:3])).permute(0, 1, 3, 2, 4, 5)
            read.append(both.flatten(1, 3))
        return torch.cat(read, dim=1)
