"""The rows of DriveWorld's Table 1, and occupancy in 3-D, with which its other tables compare."""

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
"""What each row changes; the full model has task prompts besides."""


def driveworld_rows(full: DriveWorldRecipe) -> dict[str, DriveWorldRecipe]:
    """All rows by name, the full DriveWorld first under its own; the others are named FULL_ROW.

    Table 1: `scratch` (no pre-training); `rssm`, plain latent dynamics in one vector; `ssp`, with Static
    Scene Propagation; `dmb`, with the Dynamic Memory Bank too; `mln`, with motion-aware layer normalisation
    too; the full one has task prompts besides. `occupancy` is pre-trained by the occupancy of single frames,
    as OccNet and UniScene are. All are fine-tuned alike. `carried` is no row of the paper: the full one whose
    statics move along with the ego vehicle.

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
        "rssm": replace(full, model=replace(ssp, statics=0)),
        "ssp": replace(full, model=ssp),
        "dmb": replace(full, model=dmb),
        "mln": replace(full, model=mln),
        "carried": replace(full, model=replace(size, carry_statics=True)),
    }
    found = {full.name: full}
    for name, recipe in rows.items():
        about = f"{full.name}: {ROWS[name]}"
        found[f"{full.name}_{name}"] = replace(recipe, name=f"{full.name}_{name}", about=about)
    return found
