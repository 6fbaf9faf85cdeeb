"""Features of Inception-v3 for the Fréchet distance of sets of images (FID; Heusel et al., 2017).

The network is the one of the original FID, of 2015 (pt_inception-2015-12-05-6726825d.pth, which pytorch-fid
and torch-fidelity publish). It differs from torchvision's: averages do not count padding, and the last block
takes the maximum. Names of layers are those of that file.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

SIDE_PX = 299
FEATURES = 2048
Kernel = int | tuple[int, int]
Step = tuple[tuple[str, int, Kernel, int], ...]
"""Layers that take the same input, with their results side by side: name, channels, kernel, stride."""


class InceptionFeatures(nn.Module):
    """The 2048 features that FID compares, with random weights until others are loaded."""

    num_features = FEATURES

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = _Convolution(3, 32, 3, 2)
        self.Conv2d_2a_3x3 = _Convolution(32, 32, 3, 1, padded=False)
        self.Conv2d_2b_3x3 = _Convolution(32, 64, 3, 1)
        self.Conv2d_3b_1x1 = _Convolution(64, 80, 1, 1)
        self.Conv2d_4a_3x3 = _Convolution(80, 192, 3, 1, padded=False)
        self.Mixed_5b, self.Mixed_5c, self.Mixed_5d = _block_a(192, 32), _block_a(256, 64), _block_a(288, 64)
        self.Mixed_6a = _block_b(288)
        self.Mixed_6b, self.Mixed_6c = _block_c(768, 128), _block_c(768, 160)
        self.Mixed_6d, self.Mixed_6e = _block_c(768, 160), _block_c(768, 192)
        self.Mixed_7a = _block_d(768)
        self.Mixed_7b, self.Mixed_7c = _block_e(1280, "average"), _block_e(2048, "maximum")

    def forward(self, images: UInt8[Tensor, "n 3 H W"]) -> Float[Tensor, "n 2048"]:
        """Return the features of images of any size."""
        # Pixels 0 to 255 to about -1 to 1, as the TensorFlow network expects
        x = (resized(images.float()) - 128) / 128
        x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
        x = F.max_pool2d(x, 3, 2)
        x = F.max_pool2d(self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(x)), 3, 2)
        # Mixed blocks in order; 6a and 7a halve the resolution
        for name in ("5b", "5c", "5d", "6a", "6b", "6c", "6d", "6e", "7a", "7b", "7c"):
            x = getattr(self, f"Mixed_{name}")(x)
        return x.mean((2, 3))


class _Convolution(nn.Module):
    def __init__(self, channels: int, width: int, kernel: Kernel, stride: int, padded: bool = True) -> None:
        super().__init__()
        size = (kernel, kernel) if isinstance(kernel, int) else kernel
        # The stem convolutions without padding and all strided ones are "valid" in TensorFlow's terms
        padding = (size[0] // 2, size[1] // 2) if padded and stride == 1 else (0, 0)
        self.conv = nn.Conv2d(channels, width, size, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(width, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)), inplace=True)


class _Block(nn.Module):
    """Branches side by side, each a series of steps, and a branch behind a pooling."""

    def __init__(self, channels: int, branches: list[list[Step]], pool: str, pooled: int) -> None:
        super().__init__()
        self.pool = pool
        self.branches = [[[name for name, *_ in step] for step in branch] for branch in branches]
        for branch in branches:
            # Layers of one step share their input; the next step reads their concatenated outputs
            inputs = channels
            for step in branch:
                for name, width, kernel, stride in step:
                    self.add_module(name, _Convolution(inputs, width, kernel, stride))
                inputs = sum(width for _, width, *_ in step)
        if pooled:
            self.branch_pool = _Convolution(channels, pooled, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        branches = []
        for branch in self.branches:
            y = x
            for step in branch:
                y = torch.cat([getattr(self, name)(y) for name in step], dim=1)
            branches.append(y)
        return torch.cat([*branches, self._pooled(x)], dim=1)

    def _pooled(self, x: Tensor) -> Tensor:
        if self.pool == "halved":
            return F.max_pool2d(x, 3, 2)
        if self.pool == "maximum":
            return self.branch_pool(F.max_pool2d(x, 3, 1, 1))
        return self.branch_pool(F.avg_pool2d(x, 3, 1, 1, count_include_pad=False))


def _in_a_row(name: str, *layers: tuple[int, Kernel, int]) -> list[Step]:
    return [((f"{name}_{number}", *layer),) for number, layer in enumerate(layers, start=1)]


def _block_a(channels: int, pooled: int) -> _Block:
    branches: list[list[Step]] = [
        [(("branch1x1", 64, 1, 1),)],
        _in_a_row("branch5x5", (48, 1, 1), (64, 5, 1)),
        _in_a_row("branch3x3dbl", (64, 1, 1), (96, 3, 1), (96, 3, 1)),
    ]
    return _Block(channels, branches, "average", pooled)


def _block_b(channels: int) -> _Block:
    branches: list[list[Step]] = [
        [(("branch3x3", 384, 3, 2),)],
        _in_a_row("branch3x3dbl", (64, 1, 1), (96, 3, 1), (96, 3, 2)),
    ]
    return _Block(channels, branches, "halved", 0)


def _block_c(channels: int, width: int) -> _Block:
    # A 7x7 convolution is factorised into 1x7 and 7x1
    wide, tall = (1, 7), (7, 1)
    branches: list[list[Step]] = [
        [(("branch1x1", 192, 1, 1),)],
        _in_a_row("branch7x7", (width, 1, 1), (width, wide, 1), (192, tall, 1)),
        _in_a_row(
            "branch7x7dbl",
            (width, 1, 1),
            (width, tall, 1),
            (width, wide, 1),
            (width, tall, 1),
            (192, wide, 1),
        ),
    ]
    return _Block(channels, branches, "average", 192)


def _block_d(channels: int) -> _Block:
    branches: list[list[Step]] = [
        _in_a_row("branch3x3", (192, 1, 1), (320, 3, 2)),
        _in_a_row("branch7x7x3", (192, 1, 1), (192, (1, 7), 1), (192, (7, 1), 1), (192, 3, 2)),
    ]
    return _Block(channels, branches, "halved", 0)


def _block_e(channels: int, pool: str) -> _Block:
    def forked(name: str) -> Step:
        return ((f"{name}a", 384, (1, 3), 1), (f"{name}b", 384, (3, 1), 1))

    branches: list[list[Step]] = [
        [(("branch1x1", 320, 1, 1),)],
        [*_in_a_row("branch3x3", (384, 1, 1)), forked("branch3x3_2")],
        [*_in_a_row("branch3x3dbl", (448, 1, 1), (384, 3, 1)), forked("branch3x3dbl_3")],
    ]
    return _Block(channels, branches, pool, 192)


def resized(images: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n 3 299 299"]:
    """Resize as TensorFlow 1 did: bilinear, with the corners of the first pixels on each other."""
    for dim in (2, 3):
        # Source coordinate of each output pixel, without the half-pixel shift of modern resizing
        position = torch.arange(SIDE_PX, device=images.device) * (images.shape[dim] / SIDE_PX)
        low = position.long()
        high = (low + 1).clamp(max=images.shape[dim] - 1)
        # The weights broadcast along `dim`: rows need one trailing axis, columns none
        share = (position - low).view(-1, *[1] * (3 - dim))
        images = images.index_select(dim, low) * (1 - share) + images.index_select(dim, high) * share
    return images
