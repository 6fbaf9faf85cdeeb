"""Open finished reconstructions without their logs."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foredrive.data import LogPath
from foredrive.engine.folder import CONFIG, LOG, WEIGHTS
from foredrive.errors import InputError
from foredrive.methods.reconstruction.edits import Edit, EditedScene, apply_edits
from foredrive.methods.reconstruction.reconstructed import ReconstructedScene
from foredrive.methods.reconstruction.vehicle import LoggedVehicle, load_vehicle
from foredrive.runs.recipes.reconstruction import ReconstructionRecipe, load_reconstruction_recipe
from foredrive.runs.reconstruction.reconstruct import VEHICLE, open_scene


@dataclass(frozen=True)
class OpenedReconstruction:
    """A scene without edits, and the vehicle that recorded it."""

    folder: Path
    scene: ReconstructedScene
    vehicle: LoggedVehicle


def open_reconstruction(folder: Path) -> OpenedReconstruction:
    """Open a reconstruction.

    Raises:
        InputError: the folder holds no finished reconstruction.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not a reconstruction folder (no {CONFIG})")
    recipe = load_reconstruction_recipe(folder / CONFIG)
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"{folder}: not finished; continue it with `foredrive reconstruct`")
    if not (folder / VEHICLE).is_file():
        raise InputError(f"{folder}: made by an earlier version (no {VEHICLE}); reconstruct the log again")
    vehicle = load_vehicle(folder / VEHICLE)
    return OpenedReconstruction(folder, open_scene(recipe, folder / WEIGHTS, vehicle), vehicle)


def edited_scene(scene: ReconstructedScene, edits: list[Edit]) -> EditedScene:
    """Apply edits to a scene; open the runs that inserted actors come from."""
    return apply_edits(scene.graph, edits, lambda run: open_reconstruction(Path(run)).scene.graph)


def open_run_log(folder: Path) -> tuple[ReconstructionRecipe[Any], LogPath]:
    """Return the recipe of a reconstruction and the path of its log.

    Raises:
        InputError: the folder holds no reconstruction, or its log no longer exists.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not a reconstruction folder (no {CONFIG})")
    try:
        named = json.loads((folder / LOG).read_text())
        path = LogPath(Path(named["folder"]), Path(named["maps_dir"]))
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{folder / LOG}: cannot be read as the path of a log: {error}") from error
    if not path.folder.is_dir():
        raise InputError(f"{folder}: its log no longer exists: {path.folder}")
    return load_reconstruction_recipe(folder / CONFIG), path
