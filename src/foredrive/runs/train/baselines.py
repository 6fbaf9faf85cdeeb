"""What a trained model has to beat, fitted to the very logs that it was trained on."""

import dataclasses
from functools import lru_cache
from pathlib import Path

from torch.utils.data import DataLoader

from foredrive.data import ClipConfig, ClipDataset, LogPath, collate
from foredrive.evaluation import fit_ego_mlp, read_training_set
from foredrive.metrics import VoxelPrior
from foredrive.models.ego_mlp import EgoMLP


@lru_cache(maxsize=1)  # training starts from it, evaluation wants it again, and so does a study's next arm
def fit_rivals(
    logs: tuple[LogPath, ...], clips: ClipConfig, cache_dir: Path, past_frames: int, target: bool = False
) -> tuple[VoxelPrior, EgoMLP]:
    """The voxel prior of the labels and the MLP that sees ego status alone; reads all clips, without images.

    The MLP's seed is always the same: two differ by as much as looking may bring.

    Args:
        past_frames: of the ego status.
        target: whether the ego status knows where the route leads.

    Raises:
        InputError: on logs that cannot be read.
    """
    blind = dataclasses.replace(clips, cameras=(), future_images=False)
    loader = DataLoader(ClipDataset(logs, blind, cache_dir), batch_size=16, collate_fn=collate)
    prior, status = read_training_set(loader, clips.future_frames + 1, past_frames, target=target)
    mlp = fit_ego_mlp(status, past_frames=past_frames, dt_s=clips.horizon_dt_s, seed=0, target=target)
    return prior, mlp
