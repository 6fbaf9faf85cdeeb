"""Scenes of finished reconstructions, opened without their logs."""

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file

from foredrive.errors import InputError
from foredrive.recipes.config import load_values
from foredrive.recipes.gaussians import RebuildRecipe
from foredrive.recipes.reconstruct import CONFIG, WEIGHTS
from foredrive.rendering.edits import Edit, Edited, apply_edits
from foredrive.rendering.gaussians import Gaussians
from foredrive.rendering.rebuilt import RebuiltScene
from foredrive.rendering.scene_graph import SceneGraph
from foredrive.rendering.tracks import Tracks
from foredrive.training.checkpoints import load_weights


def open_scene(folder: Path) -> RebuiltScene:
    """The scene of a run, as it was learned.

    Raises:
        InputError: on a folder without a finished run.
    """
    if not (folder / CONFIG).is_file():
        raise InputError(f"{folder}: not the folder of a reconstruction (no {CONFIG})")
    recipe = load_values(RebuildRecipe, folder / CONFIG)
    if not (folder / WEIGHTS).is_file():
        raise InputError(f"{folder}: not finished; go on with `foredrive reconstruct`")
    try:
        saved = load_file(folder / WEIGHTS)
        gaussians = Gaussians(
            saved["mean_m"],
            saved["quaternion"],
            saved["log_scale"],
            saved["opacity_logit"],
            saved["albedo"].new_zeros(
                len(saved["albedo"]), saved["albedo"].shape[1] + saved["feature"].shape[1]
            ),
        )
        tracks = Tracks(
            saved["track_id"],
            saved["category"],
            saved["size_lwh"],
            saved["key_t_s"],
            saved["T_scene_actor"],
            saved["present"],
        )
        cameras, graph = len(saved["camera_late_s"]), SceneGraph(gaussians, saved["actor"], tracks)
    except (OSError, SafetensorError, KeyError) as error:
        raise InputError(f"{folder / WEIGHTS}: not the weights of a scene: {error}") from error
    scene = RebuiltScene(graph, cameras, recipe.rolling, recipe.decoder_width)
    load_weights(scene, folder / WEIGHTS)
    return scene


def edited_scene(scene: RebuiltScene, edits: list[Edit]) -> Edited:
    """A scene after edits; runs that actors come from are opened."""
    return apply_edits(scene.graph, edits, lambda run: open_scene(Path(run)).graph)
