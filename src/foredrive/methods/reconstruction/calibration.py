"""A check of camera calibration: images against lidar.

Where lidar sees one object in front of another, the image should have an edge (Levinson & Thrun, "Automatic
online calibration of cameras and lasers", RSS 2013). A step of range between two beams of one channel is an
edge with a change of brightness from left to right, a step between two channels one from top to bottom. The
strength of image edges is measured against that of their surroundings: otherwise an offset that moves all
points into a part of the image with much texture would seem to fit better. The score is highest at the true
calibration, and lower at an error of half a degree or a decimetre.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.precision import full_precision
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import exp_se3, inverse_se3, transform_points
from foredrive.methods.reconstruction.sweep_edges import SweepEdges
from foredrive.methods.reconstruction.views import CameraView

ROTATION_STEPS_RAD = tuple(
    (axes, math.radians(step)) for axes, step in ((2, 1.0), (2, 0.5), (3, 0.5), (3, 0.25))
)
TRANSLATION_STEPS_M = ((3, 0.5), (3, 0.2), (3, 0.1), (3, 0.05))
DELAY_STEPS_S = ((1, 0.02), (1, 0.01))
"""Steps of the searches, from coarse to fine: the number of axes that are searched, and the size of the step.
The first are tried on a grid, the others climb.
"""
MAX_ROTATION_RAD, MAX_TRANSLATION_M, MAX_DELAY_S = math.radians(7.0), 0.8, 0.12
"""Bounds of the searches. The best offset within them is no optimum if it lies at a bound."""
_MIN_VIEWS = 4
_MIN_EDGES, _MAX_EDGES = 30, 800
"""Minimum number of points in an image (and of each kind by which a sum is divided), and maximum number."""
_WIDTH_PX = 480
"""Maximum image width."""
_SURROUNDINGS_RAD = math.radians(4.0)
"""Size of the surroundings against which the strength of an image edge is measured."""
_MIN_CHANGE, _MAX_STRENGTH = 0.002, 4.0
"""Mean change of brightness below which surroundings are flat, and largest strength in units of the mean."""
_GOOD_SCORE, _FAR_GAIN = 0.35, 0.15
"""Score from which the nearest optimum is taken, since repeated structures look alike, and the gain by which
another must be better if the nearest scores less.
"""
_BESIDE_VIEW_RAD = math.radians(8.0)
"""Points are kept that are seen up to this angle beside a view."""
_TYPICAL_RANGE_M = 10.0
_MIN_FOCAL = 150.0
"""Minimum focal length, px/rad: coarser images cannot show half a degree."""


@dataclass(frozen=True)
class CalibrationViews:
    """V images of one camera, each with the N points of lidar edges near its field of view."""

    K: Float[Tensor, "V 3 3"]
    dist: Float[Tensor, "V 5"]
    size_hw: tuple[int, int]
    twist_cam: Float[Tensor, "V 6"]
    R_cam_ego: Float[Tensor, "V 3 3"]
    """Rotation from the sweep's ego axes to the camera's."""
    strength: Sequence[Float[Tensor, "V 2 _H _W"]]
    """Strength of image edges that brightness crosses along u and along v; 0 is that of the surroundings.
    A pyramid: its cells are 1, 2, 4, … pixels.
    """
    points_cam: Float[Tensor, "V N 3"]
    horizontal: Bool[Tensor, "V N"]
    points_valid: Bool[Tensor, "V N"]

    def __len__(self) -> int:
        return len(self.K)


@dataclass(frozen=True)
class OffsetFit:
    """Agreement of the sensors as calibrated and after the best offset."""

    score_before: float
    """Score as calibrated, typically 0.3 to 1; 0 is chance."""
    score_after: float
    """Score with `offset`."""
    offset: Float[Tensor, "D"]
    improved_share: float
    """Share of the views that fit better with `offset`."""
    bounded: bool
    """True if the search ended at its bound, so that `offset` is no optimum."""

    @property
    def gain(self) -> float:
        """Return the increase of agreement."""
        return self.score_after - self.score_before


def calibration_views(cameras: Sequence[CameraView], edges: Sequence[SweepEdges]) -> CalibrationViews | None:
    """Pair the images of one camera with the sweeps nearest in time.

    Args:
        cameras: views with images of one camera.
        edges: lidar edges of the same drive.

    Returns:
        The views, or None if fewer than four images show lidar edges, or if they are too coarse.
    """
    if not cameras or float(_downsampled(cameras[0]).K[0, 0]) < _MIN_FOCAL:
        return None
    pairs = []
    for sweep in edges:
        # The image nearest in time, so that little of the scene has moved between image and sweep
        view = _downsampled(min(cameras, key=lambda other: abs(other.t_s - sweep.t_s)))
        T_cam_ego = inverse_se3(view.T_scene_cam) @ sweep.T_scene_ego
        # The vehicle's motion between sweep and exposure is part of this transform
        points_cam = transform_points(T_cam_ego, sweep.points_ego)
        # An image without enough lidar edges in view cannot be scored
        if int(project(points_cam, view.K, view.dist, view.size_hw)[2].sum()) >= _MIN_EDGES:
            # Keep points that a camera moved within the search bounds can see, thinned to the maximum
            near = _near_view(points_cam, view).nonzero()[:, 0]
            near = near[:: math.ceil(len(near) / _MAX_EDGES)]
            pairs.append((view, T_cam_ego, points_cam[near], sweep.horizontal[near]))
    if len(pairs) < _MIN_VIEWS:
        return None
    views = [view for view, *_ in pairs]
    counts = torch.tensor([len(points) for _, _, points, _ in pairs])
    pad = torch.nn.utils.rnn.pad_sequence
    # Point sets of different length are padded to one batch; `points_valid` marks the real ones
    return CalibrationViews(
        K=torch.stack([view.K for view in views]),
        dist=torch.stack([view.dist for view in views]),
        size_hw=views[0].size_hw,
        twist_cam=torch.stack([view.twist_cam for view in views]),
        R_cam_ego=torch.stack([T_cam_ego[:3, :3] for _, T_cam_ego, _, _ in pairs]),
        strength=_pyramid(_edge_strength(views)),
        points_cam=pad([points for _, _, points, _ in pairs], batch_first=True),
        horizontal=pad([horizontal for *_, horizontal in pairs], batch_first=True),
        # Row v is True for the first counts[v] points
        points_valid=torch.arange(int(counts.max())) < counts[:, None],
    )


def agreement(views: CalibrationViews, step_rad: float = 0.0) -> float:
    """Return the score as calibrated (see `OffsetFit.score_before`), in images as coarse as a step."""
    return float(_scores(views, torch.eye(4).expand(len(views), 4, 4), step_rad).mean())


def best_camera_rotation(views: CalibrationViews) -> OffsetFit:
    """Find the rotation of a camera that fits best: up, to its right, clockwise, rad."""

    def scores(offset: Tensor, step: float) -> Tensor:
        # Moving the camera by exp(offset) moves its points by the inverse
        T_moved_cam = inverse_se3(exp_se3(F.pad(offset, (3, 0)))).expand(len(views), 4, 4)
        return _scores(views, T_moved_cam, step)

    return _search(scores, ROTATION_STEPS_RAD, MAX_ROTATION_RAD)


def mean_shift_rad(views: CalibrationViews, turn: Float[Tensor, "3"]) -> float:
    """Return the mean angle by which a rotation of the camera moves the edges, rad."""
    rays = F.normalize(views.points_cam[views.points_valid], dim=-1)
    turned = transform_points(exp_se3(F.pad(turn, (3, 0))), rays)
    return float((turned - rays).norm(dim=-1).mean())


def best_camera_delay(views: CalibrationViews) -> OffsetFit:
    """Find the time by which a camera was exposed later than its images say, s."""

    # Over the delay, the camera moves along its own velocity and turn rate
    def scores(offset: Tensor, _: float) -> Tensor:
        return _scores(views, inverse_se3(exp_se3(views.twist_cam * offset)), 0.0)

    return _search(scores, DELAY_STEPS_S, MAX_DELAY_S)


def best_lidar_translation(cameras: Sequence[CalibrationViews]) -> OffsetFit | None:
    """Find the translation of the lidar that fits all cameras best: forward, left, up, m."""
    if not cameras:
        return None

    def scores(offset: Tensor, step: float) -> Tensor:
        scored = []
        for views in cameras:
            # Moving the lidar by an offset moves its points by the same vector, turned to camera axes
            T_moved_cam = torch.eye(4).repeat(len(views), 1, 1)
            T_moved_cam[:, :3, 3] = views.R_cam_ego @ offset
            # The step as an angle at a typical range sets the resolution of the images
            scored.append(_scores(views, T_moved_cam, step / _TYPICAL_RANGE_M))
        return torch.cat(scored)

    return _search(scores, TRANSLATION_STEPS_M, MAX_TRANSLATION_M)


def with_images_from(cameras: Sequence[CameraView], others: Sequence[CameraView]) -> list[CameraView]:
    """Return the views with the images that another camera took nearest in time."""
    return [
        dataclasses.replace(view, image=min(others, key=lambda other: abs(other.t_s - view.t_s)).image)
        for view in cameras
    ]


def _search(
    scores: Callable[[Float[Tensor, "D"], float], Float[Tensor, "V"]],
    steps: Sequence[tuple[int, float]],
    bound: float,
) -> OffsetFit:
    """Climb to the nearest optimum, by the finest steps and by steps of decreasing size.

    If that is no good one, find another on a grid in coarse images, from where steps of decreasing size climb
    in images of increasing resolution.
    """
    dims, fine = steps[-1]

    def climbed(offset: Tensor, axes: int, step: float) -> Tensor:
        best = float(scores(offset, step).mean())
        while True:
            # Neighbours one step away along each searched axis, both ways
            near = [offset + sign * step * axis for axis in torch.eye(dims)[:axes] for sign in (-1.0, 1.0)]
            # Half of the finest step of tolerance, so that rounding does not exclude the bound itself
            within = [other for other in near if float(other.abs().max()) < bound + 0.5 * fine]
            tried = [(float(scores(other, step).mean()), other) for other in within]
            score, other = max(tried, key=lambda pair: pair[0])
            # No neighbour is better: a local optimum
            if score <= best:
                return offset
            best, offset = score, other

    def refined(offset: Tensor) -> Tensor:
        for axes, step in steps[1:]:
            offset = climbed(offset, axes, step)
        return offset

    def mean_score(offset: Tensor) -> float:
        return float(scores(offset, fine).mean())

    calibrated = torch.zeros(dims)
    # Two climbs from the calibration: directly by the finest step, and from coarse to fine
    offset = max(climbed(calibrated, dims, fine), refined(calibrated), key=mean_score)
    # The nearest optimum is poor: search the whole range on a grid of coarse steps
    if mean_score(offset) < _GOOD_SCORE:
        axes, step = steps[0]
        ticks = torch.arange(-int(bound / step), int(bound / step) + 1) * step
        # The grid covers the first axes; the others start at 0
        grid = F.pad(torch.cartesian_prod(*[ticks] * axes).reshape(-1, axes), (0, dims - axes))
        far = refined(max(grid, key=lambda other: float(scores(other, step).mean())))
        # A far optimum replaces the near one only by a clear gain, since repeated structures look alike
        offset = far if mean_score(far) > mean_score(offset) + _FAR_GAIN else offset
    before, after = scores(calibrated, fine), scores(offset, fine)
    return OffsetFit(
        score_before=float(before.mean()),
        score_after=float(after.mean()),
        offset=offset,
        improved_share=float((after > before).float().mean()),
        bounded=float(offset.abs().max()) > bound - 0.5 * fine,
    )


def _scores(
    views: CalibrationViews, T_moved_cam: Float[Tensor, "V 4 4"], step_rad: float
) -> Float[Tensor, "V"]:
    """Return the mean edge strength at edges of each kind, summed over both kinds, with the cameras moved.

    Args:
        views: the images.
        T_moved_cam: maps from the calibrated to the moved camera.
        step_rad: the images are so coarse that their cells are at most this large.
    """
    points_cam = transform_points(T_moved_cam, views.points_cam)
    uv, _, inside = project(points_cam, views.K, views.dist, views.size_hw)
    # A coarse step reads coarse cells, so that edges are not stepped over between two tries
    step_px = max(step_rad * float(views.K[0, 0, 0]), 1.0)
    level = min(int(math.log2(step_px)), len(views.strength) - 1)
    strength = views.strength[level]
    # ceil_mode lets the coarse cells cover a little more than the image: normalise by what they cover
    covered_wh = torch.tensor([strength.shape[-1], strength.shape[-2]]) * 2**level
    with full_precision(strength, uv) as (strength, uv):
        where = (2 * uv / covered_wh - 1)[:, None]
        sampled = F.grid_sample(strength, where, align_corners=False)[:, :, 0]
    score = torch.zeros(len(views))
    # Beams side by side meet edges across u (kind 0), beams above each other edges across v (kind 1)
    for kind, belongs in enumerate((~views.horizontal, views.horizontal)):
        weight = (inside & views.points_valid & belongs).float()
        # The bound on the divisor keeps a few points from a high score
        score += (sampled[:, kind] * weight).sum(-1) / weight.sum(-1).clamp_min(_MIN_EDGES)
    return score


def _downsampled(view: CameraView) -> CameraView:
    return view.shrunk(max(view.size_hw[1] // _WIDTH_PX, 1))


def _near_view(points_cam: Float[Tensor, "N 3"], view: CameraView) -> Bool[Tensor, "N"]:
    """Return which points a camera may see that is turned or moved within the bounds of the searches."""
    height, width = view.size_hw
    # Half the field of view to the corner: horizontal and vertical half angles, combined
    half_rad = torch.atan2(torch.tensor([width, height]), 2 * view.K.diagonal()[:2]).norm()
    off_axis_rad = torch.atan2(points_cam[:, :2].norm(dim=-1), points_cam[:, 2])
    # The margin covers a turned camera and a moved lidar
    return off_axis_rad < half_rad + _BESIDE_VIEW_RAD


def _edge_strength(views: Sequence[CameraView]) -> Float[Tensor, "V 2 H W"]:
    """Return the change of brightness along u and v in units of its local mean, less the mean of that."""
    images = [view.image for view in views if view.image is not None]
    # Grey in 0 to 1, smoothed over 3x3 pixels against noise
    grey = torch.stack([image.float().mean(0, keepdim=True) / 255 for image in images])
    grey = F.avg_pool2d(grey, 3, stride=1, padding=1, count_include_pad=False)
    along_v, along_u = torch.gradient(grey, dim=(-2, -1))
    change = torch.cat([along_u, along_v], dim=1).abs()
    # Side of the surroundings in pixels at the image centre
    cell_px = max(round(_SURROUNDINGS_RAD * float(views[0].K[0, 0])), 1)
    # Relative strength: texture raises the mean and so lowers each of its edges; outliers are clipped
    strength = (change / (_local_mean(change, cell_px) + _MIN_CHANGE)).clamp(max=_MAX_STRENGTH)
    # Less its local mean: a random place scores 0 on average
    return strength - _local_mean(strength, cell_px)


def _pyramid(values: Float[Tensor, "V C H W"], levels: int = 4) -> list[Tensor]:
    """Return the values, and their means over cells of 2, 4, … pixels."""
    pyramid = [values]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2, ceil_mode=True))
    return pyramid


def _local_mean(values: Float[Tensor, "V C H W"], cell_px: int) -> Float[Tensor, "V C H W"]:
    """Return the means of cells, interpolated between their centres."""
    means = F.avg_pool2d(values, cell_px, ceil_mode=True, count_include_pad=False)
    # The interpolated means cover whole cells; the last ones are cut at the border of the image
    whole_hw = (means.shape[-2] * cell_px, means.shape[-1] * cell_px)
    grown = F.interpolate(means, whole_hw, mode="bilinear", align_corners=False)
    return grown[..., : values.shape[-2], : values.shape[-1]]
