"""Open finished reconstructions without their logs."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file

from foredrive.data import LogPath
from foredrive.errors import InputError
from foredrive.recipes.gaussians import RebuildRecipe, load_rebuild_recipe
from foredrive.rendering.edits import Edit, EditedScene, apply_edits
from foredrive.rendering.gaussians import Gaussians
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.scene_graph import SceneGraph
from foredrive.rendering.tracks import ActorTracks
from foredrive.rendering.vehicle import LoggedVehicle, load_vehicle
from foredrive.runs.folder import CONFIG, LOG, WEIGHTS
from foredrive.runs.rebuild.reconstruct import VEHICLE
from foredrive.training.checkpoints import load_weights


@dataclass(frozen=True)
class OpenedReconstruction:
    """A scene without edits, and the vehicle that recorded it."""

    folder: Path
    scene: RebuiltScene
    vehicle: LoggedVehicle


def open_rebuilt(folder: Path) -> OpenedReconstruction:
    """Open a reconstruction.

    Raises:
        InputError: the folder holds no finished reconstruction.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not a reconstruction folder (no {CONFIG})")
    recipe = load_rebuild_recipe(folder / CONFIG)
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"{folder}: not finished; continue it with `foredrive reconstruct`")
    if not (folder / VEHICLE).is_file():
        raise InputError(f"{folder}: made by an earlier version (no {VEHICLE}); reconstruct the log again")
    vehicle = load_vehicle(folder / VEHICLE)
    try:
        graph, cameras, frames = _read_graph(folder / WEIGHTS)
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"{folder / WEIGHTS}: not the weights of a scene: {error}") from error
    scene = RebuiltScene(graph, cameras, recipe.scene, vehicle.reach_m, frames)
    load_weights(scene, folder / WEIGHTS)
    return OpenedReconstruction(folder, scene, vehicle)


def edited_scene(scene: RebuiltScene, edits: list[Edit]) -> EditedScene:
    """Apply edits to a scene; open the runs that inserted actors come from."""
    return apply_edits(scene.graph, edits, lambda run: open_rebuilt(Path(run)).scene.graph)


def _read_graph(weights: Path) -> tuple[SceneGraph, int, int]:
    """Return a graph of the saved sizes, and the numbers of cameras and of frames with velocities."""
    saved = load_file(weights)
    features = saved["albedo"].shape[1] + saved["feature"].shape[1]
    gaussians = Gaussians(
        saved["mean_m"],
        saved["quaternion"],
        saved["log_scale"],
        saved["opacity_logit"],
        saved["albedo"].new_zeros(len(saved["albedo"]), features),
    )
    tracks = ActorTracks(
        saved["track_id"],
        saved["category"],
        saved["size_lwh"],
        saved["key_t_s"],
        saved["T_scene_actor"],
        saved["present"],
    )
    frames = len(saved.get("frame_velocity", ()))
    return SceneGraph(gaussians, saved["actor"], tracks), len(saved["camera_late_s"]), frames


def open_run_log(folder: Path) -> tuple[RebuildRecipe, LogPath]:
    """Return the recipe of a reconstruction and the path of its log.

    Raises:
        InputError: the folder holds no reconstruction, or its log no longer exists.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not a reconstruction folder (no {CONFIG})")
    try:
        named = json.loads((folder / LOG).read_text())
        path = LogPath(Path(named["folder"]), Path(named["maps_dir"]))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{folder / LOG}: cannot be read as the path of a log: {error}") from error
    if not path.folder.is_dir():
        raise InputError(f"{folder}: its log no longer exists: {path.folder}")
    return load_rebuild_recipe(folder / CONFIG), path


def camera_indices(there: Sequence[str], wanted: Sequence[str]) -> list[int]:
    """Return the index of the reconstructed camera for each camera that an agent requires.

    Raises:
        InputError: some cameras were not reconstructed; the error names them.
    """
    if missing := [name for name in wanted if name not in there]:
        raise InputError(
            f"cameras not reconstructed: {', '.join(missing)}; available: {', '.join(there) or 'none'}"
        )
    return [there.index(name) for name in wanted]
