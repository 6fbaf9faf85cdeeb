"""Eyes of a driver: a small convolutional network on two cameras and some key frames."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from foredrive.driver.route_cells import HEIGHTS_M, line_cells, route_cells, sample_cameras
from foredrive.driver.sight import RouteReader, Sight, conv_block
from foredrive.errors import InputError
from foredrive.geometry.se3 import compose_se3, inverse_se3, transform_points
from foredrive.scene import Clip

FINE, COARSE, FINE_READ = 32, 48, 16
"""Channels of the features at strides 4 and 8, and how many of the former the cells read."""
MEAN_GREY, SPREAD_GREY = 0.45, 0.25
ACROSS_MPS = (-5.0, -2.5, 0.0, 2.5, 5.0)
"""Speeds across the route, positive to the left, at which the frames before are compared with now."""


@dataclass(frozen=True)
class CameraEyesConfig:
    """Sizes of `CameraEyes`."""

    frames: int = 2
    """Key frames that are read, now included."""
    cameras: int = 2
    """Number of cameras that are read."""
    signs: bool = False
    """Stop signs are read too."""
    blind: bool = False
    """Images are black, to measure what follows from the route alone."""
    kind: Literal["cameras"] = "cameras"


class FrameFeatures(NamedTuple):
    """Features of the images of one key frame."""

    fine: Float[Tensor, "b C F h w"]
    """At stride 4."""
    coarse: Float[Tensor, "b C K y x"]
    """At stride 8."""


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

    Of the frames before now the first camera alone is looked at. Cells of the route are fixed in the world:
    there they are read where the camera was then, so that what moves differs between frames and what stands
    does not.

    Args:
        config: sizes.
    """

    def __init__(self, config: CameraEyesConfig) -> None:
        super().__init__()
        self.config = config
        self.trunks = nn.ModuleList([Trunk() for _ in range(config.cameras)])
        self.narrow = nn.ModuleList([nn.Conv2d(FINE, FINE_READ, 1) for _ in range(config.cameras)])
        views = config.cameras + config.frames - 1
        # Per view: coarse and fine features at each height, and whether the camera sees the place
        of_place = COARSE + FINE_READ + 1
        of_motion = (config.frames - 1) * len(HEIGHTS_M) * len(ACROSS_MPS)
        self.reader = RouteReader(
            views * len(HEIGHTS_M) * of_place + of_motion,
            config.cameras * of_place,
            FINE + COARSE,
            COARSE,
            config.cameras,
            signs=config.signs,
        )

    def forward(self, clip: Clip) -> Sight:
        """Return what is seen of the route at now.

        Raises:
            InputError: the clip has other cameras or fewer frames.
        """
        clip = blacked(clip) if self.config.blind else clip
        frames = seen_frames(clip, self.config.frames, self.config.cameras)
        features = self._features(frames)
        fine, coarse = features[-1]
        # Coarse features at the size of the fine ones, for the lamps
        wide = F.interpolate(coarse.flatten(0, 1), size=fine.shape[-2:], mode="nearest")
        wide = wide.unflatten(0, coarse.shape[:2])
        places = route_cells(clip.route_xy, clip.route_valid)
        cells = torch.cat(
            [self._read(frames, places, features), self._motion(frames, places, features)], dim=1
        )
        now, line = frames.frames([frames.now]), line_cells(clip.route_xy, clip.route_valid)
        ground = self._read(now, line, features[-1:], (0.0,))
        at_4 = torch.cat([fine, wide], dim=2)
        sight: Sight = self.reader(clip, cells, ground, at_4, coarse.mean((-2, -1)))
        return sight

    def _features(self, frames: Clip) -> list[FrameFeatures]:
        """Return the features of each frame: of all cameras at now, of the first one before."""
        images = frames.images
        b, t = images.shape[:2]
        # The first camera's images of all frames in one pass; the others only at now
        of_first = [map_.unflatten(0, (b, t)) for map_ in self._seen(0, images[:, :, 0].flatten(0, 1))]
        others = [self._seen(c, images[:, -1, c]) for c in range(1, len(self.trunks))]
        past = [FrameFeatures(*(map_[:, k, None] for map_ in of_first)) for k in range(t - 1)]
        now = [
            torch.stack([map_[:, -1], *rest], dim=1) for map_, *rest in zip(of_first, *others, strict=True)
        ]
        return [*past, FrameFeatures(*now)]

    def _seen(
        self, camera: int, images: UInt8[Tensor, "n 3 H W"]
    ) -> tuple[Float[Tensor, "n _F _h _w"], Float[Tensor, "n _K _y _x"]]:
        """Return the features of images of a camera at strides 4 and 8."""
        scaled = images.float().mul_(1 / (255 * SPREAD_GREY)).sub_(MEAN_GREY / SPREAD_GREY)
        fine, coarse = self.trunks[camera](scaled.contiguous(memory_format=torch.channels_last))
        return fine, coarse

    def _read(
        self,
        frames: Clip,
        cells: Float[Tensor, "b G L 2"],
        features: list[FrameFeatures],
        heights_m: Sequence[float] = HEIGHTS_M,
    ) -> Float[Tensor, "b _N G L"]:
        """Return the features of all frames and cameras in the cells, at some heights above the road."""
        count, points = len(heights_m), _at_heights(cells, heights_m)
        # Places of now in the ego frame of each key frame: features are read where the cameras were then.
        T_frame_now = _from_now(frames)
        read = []
        for t, (fine, coarse) in enumerate(features):
            moved = transform_points(T_frame_now[:, t], points)
            cameras = slice(fine.shape[1])
            rig, valid = frames.rig[:, t, cameras], frames.image_valid[:, t, cameras]
            narrow = torch.stack([self.narrow[c](fine[:, c]) for c in range(fine.shape[1])], dim=1)
            # The visibility channel is kept once, with the fine features
            at_8 = sample_cameras(coarse, valid, rig, moved)[:, :, :-1]
            at_4 = sample_cameras(narrow, valid, rig, moved)
            both = torch.cat([at_8, at_4], dim=2)  # [b C F N]
            both = both.unflatten(-1, (count, *cells.shape[1:3])).permute(0, 1, 3, 2, 4, 5)
            read.append(both.flatten(1, 3))
        return torch.cat(read, dim=1)

    def _motion(
        self, frames: Clip, cells: Float[Tensor, "b G L 2"], features: list[FrameFeatures]
    ) -> Float[Tensor, "b _N G L"]:
        """Return how much each cell looks now as the places looked from which it would have been entered.

        For each frame before, height and speed across the route of `ACROSS_MPS`: the cosine between the
        features of the first camera in the cell now, and then in the place that moves into it at this speed.
        """
        count, shape = len(HEIGHTS_M), cells.shape[1:3]
        points = _at_heights(cells)
        T_frame_now = _from_now(frames)
        # Unit vectors from the right to the left of the route, for every cell and height
        left = (cells[:, :, -1:] - cells[:, :, :1]).expand(-1, -1, shape[1], -1)
        left = F.normalize(left, dim=-1).flatten(1, 2).repeat(1, count, 1)
        left = torch.cat([left, torch.zeros_like(left[..., :1])], dim=-1)

        def looks(t: int, places: Float[Tensor, "b M 3"]) -> Float[Tensor, "b F M"]:
            narrow = self.narrow[0](features[t].fine[:, 0])[:, None]
            moved = transform_points(T_frame_now[:, t], places)
            seen = sample_cameras(narrow, frames.image_valid[:, t, :1], frames.rig[:, t, :1], moved)
            return F.normalize(seen[:, 0, :-1], dim=1)

        now, cosines = looks(len(features) - 1, points), []
        # What moves into a cell at a speed across the route was that far to the other side then.
        speeds = points.new_tensor(ACROSS_MPS)
        for t in range(len(features) - 1):
            # Distance that such a road user has moved since that frame
            gone_m = (frames.t_s[:, -1] - frames.t_s[:, t])[:, None] * speeds
            before = points[:, None] - gone_m[..., None, None] * left[:, None]
            then = looks(t, before.flatten(1, 2)).unflatten(-1, before.shape[1:3])
            # Cosine similarity of the features then and now
            cosines.append((then * now[:, :, None]).sum(1).unflatten(-1, (count, *shape)).flatten(1, 2))
        return torch.cat(cosines, dim=1) if cosines else points.new_zeros(len(points), 0, *shape)


def _at_heights(
    cells: Float[Tensor, "b G L 2"], heights_m: Sequence[float] = HEIGHTS_M
) -> Float[Tensor, "b N 3"]:
    """Return the cells at each height above the road, one height after the other."""
    z = cells.new_tensor(heights_m)[:, None, None, None].expand(-1, *cells.shape[1:3], 1)
    xy = cells[:, None].expand(-1, len(heights_m), -1, -1, -1)
    return torch.cat([xy, z.expand(len(cells), -1, -1, -1, -1)], dim=-1).flatten(1, 3)


def _from_now(frames: Clip) -> Float[Tensor, "b T 4 4"]:
    """Return the transform from the ego frame at the last key frame to that of each."""
    return compose_se3(inverse_se3(frames.T_world_ego), frames.T_world_ego[:, -1:]).float()
