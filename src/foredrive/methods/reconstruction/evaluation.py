"""Reconstructed scenes against the images and sweeps that were held out."""

import dataclasses
import time
from collections import defaultdict
from collections.abc import Sequence
from statistics import fmean

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from foredrive.geometry.boxes import box_corners
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.scene_graph import SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks, nonrigid_rows, states_at
from foredrive.methods.reconstruction.trust import psnr_of
from foredrive.methods.reconstruction.views import CameraView, SweepView
from foredrive.tasks.rendering.image_scores import psnr_db, ssim
from foredrive.tasks.rendering.lidar_scores import SweepScores, score_sweep

NEAREST_CORNER_M = 0.1
"""Least depth of all corners of a box that has a rectangle in an image, m."""
MOVING_MPS = 0.5
"""From this speed on a vehicle counts as moving."""


@torch.no_grad()
def evaluate_cameras(
    scene: ReconstructedScene,
    views: Sequence[CameraView],
    learned: Sequence[CameraView],
    graph: SceneGraph | None = None,
    where: Sequence[Bool[Tensor, "H W"]] | None = None,
) -> dict[str, float]:
    """Return PSNR and SSIM, mean over images, and under "nearest." those of the baseline.

    The baseline shows the nearest learned image of the same camera. Under "moving." are means over the images
    taken at speed: where a vehicle stands, the image before is nearly the same. `people.psnr_db` and
    `vehicles.psnr_db` are those of all pixels of the actors' boxes in all images together (after OmniRe, Chen
    et al., 2025, Table 1).

    Args:
        scene: to judge.
        views: held out, with images.
        learned: views that the scene was learned from.
        graph: the scene after edits; None: as it was learned.
        where: pixels that count, of each view; None: all.
    """
    if not views:
        return {}
    scores: dict[str, list[float]] = defaultdict(list)
    graph, took_s, pixels = graph or scene.graph, 0.0, 0
    people = nonrigid_rows(graph.tracks)
    actors = {"people": graph.tracks.only(people), "vehicles": graph.tracks.only(~people)}
    squared: dict[str, list[Tensor]] = defaultdict(list)
    for number, view in enumerate(views):
        # The time covers rendering and the copy to the CPU, which waits for the device
        started = time.perf_counter()
        rgb = scene.camera(graph, view.to(scene.device)).rgb.clamp(0, 1)[None].cpu()
        took_s += time.perf_counter() - started
        pixels += view.size_hw[0] * view.size_hw[1]
        real = _image(view)
        known = torch.ones_like(real[:, 0], dtype=torch.bool) if where is None else where[number][None]
        same_camera = [other for other in learned if other.sensor == view.sensor]
        # Baseline: the learned image of the same camera nearest in time
        for kind, tracks in actors.items():
            where_kind = actor_pixels(tracks.to("cpu"), view) & known[0]
            squared[kind].append((rgb - real).square()[0, :, where_kind].flatten())
        shown = {"": rgb}
        if same_camera:
            shown["nearest."] = _image(min(same_camera, key=lambda other: abs(other.t_s - view.t_s)))
        for prefix, image in shown.items():
            figures = {"psnr_db": psnr_db(image, real, known), "ssim": ssim(image, real, known)}
            for name, value in figures.items():
                scores[prefix + name].append(float(value))
                # Speed of the camera over ground
                if float(view.twist_cam[:3].norm()) > MOVING_MPS:
                    scores[f"moving.{prefix}{name}"].append(float(value))
    errors = {kind: torch.cat(parts) for kind, parts in squared.items()}
    return {
        **{name: fmean(values) for name, values in scores.items()},
        **{f"{kind}.psnr_db": psnr_of(error) for kind, error in errors.items() if len(error)},
        "images": float(len(views)),
        "camera_mp_per_s": pixels / took_s * 1e-6,
    }


def actor_pixels(tracks: ActorTracks, view: CameraView) -> Bool[Tensor, "H W"]:
    """Return the pixels of an image in the rectangles around the boxes of all actors that are there.

    What hides an actor counts too.
    """
    states = states_at(tracks, view.t_s)
    here = tracks.size_lwh[states.present]
    corners = box_corners(torch.zeros_like(here), here, torch.zeros_like(here[:, 0]))
    T_cam_actor = inverse_se3(view.T_scene_cam) @ states.T_scene_actor[states.present]
    uv, depth_m, _ = project(
        transform_points(T_cam_actor, corners),
        view.K.expand(len(here), 3, 3),
        view.dist.expand(len(here), -1),
        view.size_hw,
    )
    # A box that reaches behind the camera has no rectangle
    uv = uv[(depth_m > NEAREST_CORNER_M).all(-1)]
    first, last = uv.amin(1), uv.amax(1)
    v, u = (torch.arange(count) + 0.5 for count in view.size_hw)
    columns = (u >= first[:, :1]) & (u <= last[:, :1])
    rows = (v >= first[:, 1:]) & (v <= last[:, 1:])
    return (rows[:, :, None] & columns[:, None, :]).any(0)


def _image(view: CameraView) -> Float[Tensor, "1 3 H W"]:
    assert view.image is not None
    return view.image[None].cpu().float() / 255


@torch.no_grad()
def evaluate_sweeps(
    scene: ReconstructedScene,
    views: Sequence[SweepView],
    *,
    drop: bool = True,
    graph: SceneGraph | None = None,
    where: Sequence[Bool[Tensor, "P"]] | None = None,
) -> dict[str, float]:
    """Return the figures of `SweepScores`, mean over sweeps.

    Args:
        scene: to judge.
        views: held out.
        drop: whether beams that are likelier lost than not count as lost; False: all return.
        graph: the scene after edits; None: as it was learned.
        where: beams that count, of each view; None: all.
    """
    if not views:
        return {}
    scores: list[SweepScores] = []
    graph, took_s, beams_seen = graph or scene.graph, 0.0, 0
    for number, view in enumerate(views):
        points = scene.prepare_sweep(view)
        started = time.perf_counter()
        seen = scene.sweep(graph, points, view.t_s)
        range_m = seen.hit_range_m.cpu()  # Waits until a GPU has finished
        took_s += time.perf_counter() - started
        beams_seen += len(view.beams.dt_s)
        some = slice(None) if where is None else where[number]
        beams = view.beams[some]
        scores.append(
            score_sweep(
                range_m=range_m[some],
                intensity=seen.intensity.cpu()[some],
                # A beam is lost if the scene says so, and `drop` asks for it
                dropped=~seen.returned.cpu()[some] & drop,
                real_range_m=beams.range_m,
                real_intensity=beams.intensity,
                returned=beams.returned,
                origin=beams.origin_ego,
                direction=beams.dir_ego,
            )
        )
    figures = {
        field.name: fmean(getattr(score, field.name) for score in scores)
        for field in dataclasses.fields(SweepScores)
    }
    return figures | {"sweeps": float(len(views)), "lidar_mrays_per_s": beams_seen / took_s * 1e-6}
