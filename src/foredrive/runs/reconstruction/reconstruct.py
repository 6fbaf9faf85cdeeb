"""Reconstruct a log as a scene that can be rendered: a folder with recipe, weights, metrics and pictures."""

import dataclasses
import json
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from foredrive.data import LogPath
from foredrive.data.cameras import names_of_camera, pinhole_cameras
from foredrive.data.drives import lidar_of, read_drive
from foredrive.data.logs import Log
from foredrive.devices import chosen_device
from foredrive.engine.checkpoints import load_weights, save_weights
from foredrive.engine.config import save_recipe
from foredrive.engine.folder import CONFIG, LOG, SUMMARY, WEIGHTS, RunFolder
from foredrive.engine.metrics_log import read_metrics
from foredrive.engine.provenance import collect_provenance, peak_rss_gib
from foredrive.engine.summary import read_summary, write_summary
from foredrive.errors import InputError
from foredrive.files import atomic_path, together
from foredrive.methods.lidarclip.image_tower import ImageTowerFeatures
from foredrive.methods.reconstruction.evaluation import evaluate_cameras, evaluate_sweeps
from foredrive.methods.reconstruction.perceptual import PerceptualMetrics, PerceptualTower
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.representation import Representation
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.tracks import ActorTracks, joined_tracks, read_tracks, split_tracks
from foredrive.methods.reconstruction.training import SensorViews, train_representation
from foredrive.methods.reconstruction.vehicle import LoggedVehicle, read_vehicle, save_vehicle
from foredrive.methods.reconstruction.views import CameraView, SweepView, camera_views, sweep_views
from foredrive.methods.splatad.ply import write_ply
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, load_reconstruction_recipe
from foredrive.runs.reconstruction.calibration_check import calibration_findings
from foredrive.scene import Clip
from foredrive.sensors.lidar_estimation import estimate_lidar

VEHICLE = "vehicle.json"
"""File of the vehicle's path and sensors, which are needed to render a scene without its log."""
STATIC_PART = "static.ply"
"""File of the static part, for viewers of splats."""
_log = logging.getLogger(__name__)

_OF_A_BEAM = 120
"""Bytes kept for each beam of the log."""
_BEAMS_A_SWEEP = 120_000


@dataclass(frozen=True)
class ReconstructionData:
    """The training frames and the held-out frames of a drive."""

    train: SensorViews
    held_out: SensorViews
    tracks: ActorTracks
    """The actors."""
    obstacles: ActorTracks
    """Tracks that belong to the static part."""
    vehicle: LoggedVehicle


@dataclass(frozen=True)
class Reconstruction:
    """A reconstruction on disk, and its scene."""

    folder: Path
    recipe: ReconstructionRecipe[Any]
    summary: dict[str, float | int | str | None]
    scene: ReconstructedScene
    train: SensorViews
    held_out: SensorViews
    """The held-out frames on which the scene was evaluated."""


def reconstruct(
    recipe: ReconstructionRecipe[Any],
    path: LogPath,
    folder: Path,
    cache_dir: Path | None = None,
    perceptual: PerceptualMetrics | None = None,
    report: Callable[[Reconstruction], None] = lambda run: None,
) -> Reconstruction:
    """Reconstruct a log, and evaluate the scene on held-out frames.

    It continues where an earlier call with the same recipe and log stopped.

    Args:
        recipe: recipe of the reconstruction.
        path: path of the log.
        folder: folder of the run.
        cache_dir: folder for shrunk images; by default in `folder`.
        perceptual: further metrics of held-out images; they are added to a finished run too.
        report: draws pictures of the scene into `folder`, which appear together with the summary.

    Raises:
        InputError: `folder` holds a run of another recipe or log, or another process writes to it; the log
            cannot be read, has neither images nor sweeps, or needs more memory than is free.
    """
    path = path.absolute()  # a run opens from any working directory
    claim = _folder_of(recipe, path, folder)
    claim.check()
    check_memory(recipe, path)
    data = read_reconstruction_data(recipe, path, (cache_dir or folder / "cache").absolute())
    with claim.claimed():
        return _reconstruct(recipe, path, folder, data, perceptual, report)


def shipped_tower() -> PerceptualTower:
    """Return the image tower that comes with the package as a network of perception."""
    from foredrive.search.embedded import SHIPPED, load_image_tower  # few runs need it

    tower = load_image_tower(SHIPPED).eval()
    return PerceptualTower(ImageTowerFeatures(tower, enlarge=1), tower)


def _reconstruct(
    recipe: ReconstructionRecipe[Any],
    path: LogPath,
    folder: Path,
    data: ReconstructionData,
    perceptual: PerceptualMetrics | None,
    report: Callable[[Reconstruction], None],
) -> Reconstruction:
    """Do the steps of a reconstruction that are not done yet."""
    save_vehicle(data.vehicle, folder / VEHICLE)
    representation: Representation = recipe.representation
    weights, device = folder / WEIGHTS, chosen_device()
    if weights.is_file():
        # A trained scene needs no seeding, which takes longer than everything else here
        scene = open_scene(recipe, weights, data.vehicle).to(device)
    else:
        scene = initial_model(recipe, data).to(device)
        train, names = data.train, data.vehicle.rig.names
        tracks = joined_tracks(data.tracks, data.obstacles)
        for finding in calibration_findings(names, train.cameras, train.sweeps, tracks):
            if finding.large:
                _log.warning("%s: the calibration may be wrong: %s", path.folder, finding.text)
        training = representation.training(scene, data.train, lambda: shipped_tower().features)
        train_representation(training, folder)
        representation.complete(scene, data.vehicle.T_scene_ego, data.train)
        with atomic_path(weights) as temporary:
            save_weights(scene, temporary)
    with together(folder):
        if not (folder / SUMMARY).is_file():
            write_summary(folder / SUMMARY, _summary(recipe, path, folder, scene, data))
        if perceptual is not None:
            more = perceptual.evaluate(scene, data.held_out.cameras)
            write_summary(folder / SUMMARY, read_summary(folder / SUMMARY) | more)
        if not (folder / STATIC_PART).is_file():
            write_ply(scene.content.preview(STATIC), folder / STATIC_PART)
        figures = read_summary(folder / SUMMARY)
        run = Reconstruction(folder, recipe, figures, scene, data.train, data.held_out)
        report(run)
    return run


def read_reconstruction_data(
    recipe: ReconstructionRecipe[Any], path: LogPath, cache_dir: Path
) -> ReconstructionData:
    """Read a log's frames and split them into training and held-out frames; warn if sensors are missing."""
    drive = read_drive(path, recipe.image_hw, recipe.cameras, cache_dir)
    if not bool(drive.image_valid.any()) and not bool(drive.sweep_valid.any()):
        raise InputError(
            f"{path.folder}: a reconstruction needs images or lidar sweeps, and the log has neither"
        )
    every, frames = recipe.hold_out_every, torch.arange(len(drive.t_s))
    held = (frames % every == every - 1) if every else torch.zeros_like(frames, dtype=torch.bool)
    T_world_scene = drive.T_world_ego[0]
    training = drive.frames(frames[~held].tolist())
    tracks = read_tracks(training, T_world_scene)
    for lacking, what in (
        (not bool(drive.sweep_valid.any()), "no lidar: reconstructed from its images alone"),
        (len(tracks) == 0, "no tracks: everything in it is taken to stand still"),
        (len(drive.rig.names) == 1, "one camera: what it never looks at is reconstructed from lidar alone"),
        (len(drive.rig.names) == 0, "no cameras: reconstructed from its sweeps alone"),
    ):
        if lacking:
            _log.warning("%s: %s", path.folder, what)
    actors, obstacles = split_tracks(tracks, recipe.moves_m, recipe.nonrigid)
    if not recipe.actors:
        actors, obstacles = tracks.only(torch.zeros_like(tracks.present[:, 0])), tracks
    train = _sensor_views(training, T_world_scene)
    return ReconstructionData(
        train=train,
        held_out=_sensor_views(drive.frames(frames[held].tolist()), T_world_scene),
        tracks=actors,
        obstacles=obstacles,
        vehicle=_vehicle(Log(path), drive, train.sweeps),
    )


def initial_model(recipe: ReconstructionRecipe[Any], data: ReconstructionData) -> ReconstructedScene:
    """Return the scene before training."""
    vehicle = data.vehicle
    scene: ReconstructedScene = recipe.representation.begin(
        data.train, data.tracks, len(vehicle.rig.names), vehicle.reach_m
    )
    scene.keep_obstacles(data.obstacles)
    return scene


def open_scene(
    recipe: ReconstructionRecipe[Any], weights: Path, vehicle: LoggedVehicle
) -> ReconstructedScene:
    """Return a trained scene.

    Raises:
        InputError: the file cannot be read or holds no weights of such a scene.
    """
    scene: ReconstructedScene = recipe.representation.open(weights, vehicle.reach_m)
    scene.restore_obstacles(weights)
    load_weights(scene, weights)
    return scene


def check_memory(recipe: ReconstructionRecipe[Any], path: LogPath) -> None:
    """Check that the memory suffices before the reconstruction begins.

    Raises:
        InputError: there is not enough memory; the error states the required and the free memory.
    """
    log = Log(path)
    cameras = len(pinhole_cameras(log)) if recipe.cameras is None else len(recipe.cameras)
    pixels = recipe.image_hw[0] * recipe.image_hw[1]
    needed_gib = memory_needed_gib(recipe, frames=len(log), cameras=cameras)
    free_gib = _free_memory_gib()
    if needed_gib > free_gib:
        raise InputError(
            f"{recipe.name} needs about {needed_gib:.1f} GiB for {cameras} cameras of {pixels * 1e-6:.1f} MP "
            f"and {len(log)} frames; {free_gib:.1f} GiB are free"
        )


def memory_needed_gib(recipe: ReconstructionRecipe[Any], *, frames: int, cameras: int) -> float:
    """Estimate the memory of a reconstruction, GiB."""
    pixels = recipe.image_hw[0] * recipe.image_hw[1]
    kept = frames * (cameras * pixels * 3 + _BEAMS_A_SWEEP * _OF_A_BEAM)
    return recipe.representation.learning_gib(pixels) + kept / 1024**3


def _free_memory_gib() -> float:
    if (device := chosen_device()) != "cpu":
        return torch.cuda.mem_get_info(device)[0] / 1024**3
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        for line in meminfo.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) / 1024**2
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1024**3


def _vehicle(log: Log, drive: Clip, sweeps: Sequence[SweepView]) -> LoggedVehicle:
    """Return the vehicle of a drive. Its lidar is the data set's model, or is estimated from the sweeps."""
    T_world_scene = drive.T_world_ego[0]
    seen = [view for view in sweeps if bool(view.beams.returned.any())]
    other_names = tuple(names_of_camera(log, name) for name in drive.rig.names)
    if not seen:
        return dataclasses.replace(read_vehicle(drive, T_world_scene), other_names=other_names)
    fullest = max(seen, key=lambda view: len(view.beams.dt_s))
    beams, T_ego_lidar = fullest.beams, torch.eye(4)
    T_ego_lidar[:3, 3] = beams.origin_ego[beams.dt_s.abs().argmin()]
    max_range_m = max(float(view.beams.range_m[view.beams.returned].max()) for view in seen)
    lidar = lidar_of(log.metadata.dataset, T_ego_lidar) or estimate_lidar(
        beams, fullest.twist_ego, period_s=log.period_s or 0.1, reach_m=max_range_m
    )
    reach_m = max_range_m if lidar is None else lidar.max_range_m
    vehicle = read_vehicle(drive, T_world_scene, lidar, T_ego_lidar, reach_m)
    return dataclasses.replace(vehicle, other_names=other_names)


def _sensor_views(clip: Clip, T_world_scene: torch.Tensor) -> SensorViews:
    cameras: list[CameraView] = [view for views in camera_views(clip, T_world_scene) for view in views]
    sweeps: list[SweepView] = sweep_views(clip, T_world_scene)
    return SensorViews(cameras, sweeps)


def _summary(
    recipe: ReconstructionRecipe[Any],
    path: LogPath,
    folder: Path,
    scene: ReconstructedScene,
    data: ReconstructionData,
) -> dict[str, float | int | str | None]:
    steps = read_metrics(folder / "metrics.jsonl")
    held = data.held_out
    return {
        "recipe": recipe.name,
        "log": path.name,
        **scene.sizes,
        "actors": len(data.tracks),
        "obstacles": len(data.obstacles),
        "minutes": sum(float(line["step_s"]) for line in steps) / 60,
        "computing_minutes": sum(float(line["computing_s"]) for line in steps) / 60,
        "peak_memory_gib": peak_rss_gib(),
        **evaluate_cameras(scene, held.cameras, data.train.cameras),
        **evaluate_sweeps(scene, held.sweeps, drop=recipe.drop),
        **collect_provenance(),
    }


def _folder_of(recipe: ReconstructionRecipe[Any], path: LogPath, folder: Path) -> RunFolder:
    other_recipe, other_log = "a run with another recipe", "a run of another log"

    def read() -> dict[str, object] | None:
        if not (folder / CONFIG).is_file():
            return None
        recipe = load_reconstruction_recipe(folder / CONFIG)
        try:
            return {other_recipe: recipe, other_log: json.loads((folder / LOG).read_text())["folder"]}
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise InputError(f"{folder / LOG}: cannot be read as the path of a log: {error}") from error

    def write() -> None:
        with atomic_path(folder / LOG) as temporary:
            temporary.write_text(json.dumps({"folder": str(path.folder), "maps_dir": str(path.maps_dir)}))
        save_recipe(recipe, folder / CONFIG)

    return RunFolder(folder, {other_recipe: recipe, other_log: str(path.folder)}, read, write)
