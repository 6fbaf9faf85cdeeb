"""The rows of DriveWorld's Table 1, and occupancy in 3-D, with which its other tables compare."""

from dataclasses import replace

from foredrive.recipes.config import DriveWorldSize, DriveWorldStage, Recipe


def driveworld_rows(full: Recipe) -> dict[str, Recipe]:
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
    assert isinstance(size, DriveWorldSize)
    assert isinstance(stage, DriveWorldStage)
    mln = replace(size, prompt=None)
    dmb = replace(mln, motion_norm=False)
    ssp = replace(dmb, memory_bank=False)
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
        found[f"{full.name}_{name}"] = replace(recipe, name=f"{full.name}_{name}")
    return found
