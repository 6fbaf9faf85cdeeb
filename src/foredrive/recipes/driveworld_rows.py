"""The rows of DriveWorld's Table 1, and 3-D occupancy pre-training, the baseline of its other tables."""

from dataclasses import replace

from foredrive.recipes.driveworld import DriveWorldRecipe

ROWS = {
    "scratch": "without pre-training (Table 1)",
    "occupancy": "pre-trained by the occupancy of single frames, as OccNet and UniScene are",
    "rssm": "plain latent dynamics in one vector (Table 1)",
    "ssp": "rssm with Static Scene Propagation (Table 1)",
    "dmb": "ssp with the Dynamic Memory Bank (Table 1)",
    "mln": "dmb with motion-aware layer normalisation (Table 1)",
    "carried": "latent statics moved along with the ego vehicle; not in the paper",
}
"""The change of each row. The full model also has task prompts."""


def driveworld_rows(full: DriveWorldRecipe) -> dict[str, DriveWorldRecipe]:
    """Return all rows by name: the full DriveWorld first, under its own name, the others as FULL_ROW.

    Rows of Table 1:
    - `scratch`: no pre-training.
    - `rssm`: plain latent dynamics in one vector.
    - `ssp`: `rssm` with Static Scene Propagation.
    - `dmb`: `ssp` with the Dynamic Memory Bank.
    - `mln`: `dmb` with motion-aware layer normalisation.
    - The full model: `mln` with task prompts.

    Other rows: `occupancy` is pre-trained by the occupancy of single frames, like OccNet and UniScene.
    `carried` is not in the paper: the full model with statics warped by the ego motion. All rows are
    fine-tuned in the same way.

    Args:
        full: a recipe with pre-training.
    """
    size, stage = full.model, full.pretrain
    assert stage is not None
    mln = replace(size, prompt=None)
    dmb = replace(mln, states=replace(mln.states, motion_norm=False))
    ssp = replace(dmb, states=replace(dmb.states, memory_bank=False))
    rows = {
        "scratch": replace(full, pretrain=None),
        "occupancy": replace(full, pretrain=replace(stage, temporal=False)),
        "rssm": replace(full, model=replace(ssp, statics=None)),
        "ssp": replace(full, model=ssp),
        "dmb": replace(full, model=dmb),
        "mln": replace(full, model=mln),
        "carried": replace(full, model=replace(size, warp_statics=True)),
    }
    found = {full.name: full}
    for name, recipe in rows.items():
        about = f"{full.name}: {ROWS[name]}"
        found[f"{full.name}_{name}"] = replace(recipe, name=f"{full.name}_{name}", about=about)
    return found
