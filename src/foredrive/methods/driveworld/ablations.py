"""The rows of DriveWorld's Table 1, and 3-D occupancy pre-training, the baseline of its other tables."""

from dataclasses import replace

from foredrive.methods.driveworld.recipes import DriveWorldRecipe
from foredrive.methods.recipe import named_after


def driveworld_ablations(full: DriveWorldRecipe) -> dict[str, DriveWorldRecipe]:
    """Return all rows by name: the full DriveWorld first, under its own name, the others as FULL_ROW.

    The rows of Table 1 differ in pre-training alone. As in §3.5, backbone and encoder are carried over to
    fine-tuning; all other parts are those of the full DriveWorld and start fresh, the same in every row.

    Args:
        full: a recipe with pre-training.
    """
    size, stage = full.model, full.pretrain
    assert stage is not None
    alone = replace(full, transfer="encoder")
    mln = replace(size, prompt=None)
    dmb = replace(mln, states=replace(mln.states, motion_norm=False))
    ssp = replace(dmb, states=replace(dmb.states, memory_bank=False))
    rows = {
        "scratch": (replace(full, pretrain=None), "without pre-training (Table 1)"),
        "occupancy": (
            replace(alone, pretrain=replace(stage, temporal=False)),
            "encoder pre-trained by the occupancy of single frames, as OccNet and UniScene are",
        ),
        "rssm": (
            replace(alone, pretrained_model=replace(ssp, statics=None)),
            "encoder pre-trained by plain latent dynamics in one vector (Table 1)",
        ),
        "ssp": (replace(alone, pretrained_model=ssp), "rssm with Static Scene Propagation (Table 1)"),
        "dmb": (replace(alone, pretrained_model=dmb), "ssp with the Dynamic Memory Bank (Table 1)"),
        "mln": (
            replace(alone, pretrained_model=mln),
            "dmb with motion-aware layer normalisation (Table 1)",
        ),
        "prompts": (alone, "mln with task prompts (Table 1)"),
        "carried": (
            replace(full, model=replace(size, warp_statics=True)),
            "latent statics warped by the ego motion; not in the paper",
        ),
    }
    return named_after(full, rows)
