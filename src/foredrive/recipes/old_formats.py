"""Conversion of recipes from earlier formats."""

from collections.abc import Mapping
from typing import Any


def upgraded(written: Any) -> Any:
    """Return the values of a recipe in today's format. Anything else is returned unchanged.

    Until November 2026 `model` was flat: it held the sizes of the planner and of all parts side by side. NeMo
    and its stages had no `kind`, and some numbers were fixed in the code.
    """
    model = written.get("model") if isinstance(written, Mapping) else None
    if not isinstance(model, Mapping) or "planner_width" not in model:
        return written
    flat = dict(model)
    kind = flat.pop("kind", "nemo")
    planner = _planner(flat)
    checkpoint = flat.pop("checkpoint", ())
    flat["backbone"] = {**flat["backbone"], "checkpoint": "backbone" in checkpoint}
    flat["encoder"] = _encoder(flat["encoder"], "encoder" in checkpoint)
    nested = _driveworld(flat) if kind == "driveworld" else _nemo(flat)
    stages = {
        name: written[name] and {**written[name], "kind": kind}
        for name in ("pretrain", "finetune")
        if name in written
    }
    return {**written, "model": {**nested, "kind": kind}, "planner": planner, **stages}


def _planner(flat: dict[str, Any]) -> dict[str, Any]:
    """Take the planner's entries out of a flat model."""
    pool = flat.pop("attention_pool")
    entries = {key: flat.pop(key) for key in list(flat) if key.startswith("planner_")}
    planner = {key.removeprefix("planner_"): value for key, value in entries.items()} | {"pool": pool}
    base, look_m = planner.pop("base", "straight_on"), planner.pop("look_m", ())
    planner["ego_mlp"] = {"hidden": 512} if base == "ego_mlp" else None
    width = planner["width"] // 2
    planner["path"] = {"distances_m": look_m, "width": width, "hidden": width // 2} if look_m else None
    return planner


def _encoder(encoder: Mapping[str, Any], checkpoint: bool) -> dict[str, Any]:
    kind = encoder.get("kind", "volume")
    sizes = {key: value for key, value in encoder.items() if key != "kind"}
    if kind == "pooled":
        return {"lifting": {**sizes, "checkpoint": checkpoint, "kind": "lifting"}, "kind": "pooled"}
    if kind in ("averaging", "lift_splat"):
        return {**sizes, "kind": kind}
    return {**sizes, "checkpoint": checkpoint, "kind": "bev" if kind == "bev" else "lifting"}


def _nemo(flat: dict[str, Any]) -> dict[str, Any]:
    renderer = {key: flat.pop(f"ray_{key}") for key in ("near_m", "far_m", "samples")}
    renderer["hidden"] = flat.pop("recon_hidden")
    motion = {"hidden": flat.pop("motion_hidden")}
    return {**flat, "motion": motion, "renderer": renderer}


STATES = {
    "observation": "observation",
    "state": "state",
    "history": "history",
    "memory": "memory",
    "memory_heads": "heads",
    "objects": "objects",
    "states_hidden": "hidden",
    "memory_bank": "memory_bank",
    "motion_norm": "motion_norm",
}
"""Entries of DriveWorld's state space, by their names in the flat format."""


def _driveworld(flat: dict[str, Any]) -> dict[str, Any]:
    states = {name: flat.pop(key) for key, name in STATES.items() if key in flat}
    return {**flat, "states": states}
