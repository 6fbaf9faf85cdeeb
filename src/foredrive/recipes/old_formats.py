"""Conversion of recipes from earlier formats."""

from collections.abc import Mapping
from typing import Any


def upgraded(written: Any) -> Any:
    """Return the values of a recipe in today's format. Anything else is returned unchanged."""
    model = written.get("model") if isinstance(written, Mapping) else None
    if not isinstance(model, Mapping):
        return written
    nested = _nested(written) if "planner_width" in model else written
    stages = {name: _stage(nested[name]) for name in ("pretrain", "finetune") if name in nested}
    upgraded = _with_module_configs({**nested, "tasks": upgraded_heads(nested.get("tasks")), **stages})
    return _without(upgraded, {"balance": 0.0, "planner.scorer": None, "tasks.heads.affordances": None})


def _without(written: Any, unused: Mapping[str, Any]) -> Any:
    """Return values without entries of parts that are gone, where they have the value for no such part."""
    for name, value in unused.items():
        head, _, rest = name.partition(".")
        if not isinstance(written, Mapping) or head not in written:
            continue
        if rest:
            written = {**written, head: _without(written[head], {rest: value})}
        elif written[head] == value:
            written = {key: entry for key, entry in written.items() if key != head}
    return written


def upgraded_heads(written: Any) -> Any:
    """Return the values of a recipe of task heads in today's format, as `upgraded` does.

    Before carried agents had an entry for their task, they read the volume of detection.
    """
    heads = written.get("heads") if isinstance(written, Mapping) else None
    agents = heads.get("agents") if isinstance(heads, Mapping) else None
    carried = agents.get("carried") if isinstance(agents, Mapping) else None
    if not (isinstance(heads, Mapping) and isinstance(agents, Mapping) and isinstance(carried, Mapping)):
        return written
    agents = {**agents, "carried": {"task": "detection", **carried}}
    return {**written, "heads": {**heads, "agents": agents}}


def _stage(written: Any) -> Any:
    """Convert a stage from when the only network of the perceptual loss was VGG-16."""
    if not isinstance(written, Mapping) or "vgg16" not in written:
        return written
    rest = {key: value for key, value in written.items() if key != "vgg16"}
    vgg16 = written["vgg16"]
    return {**rest, "perceptual": "vgg16" if vgg16 == "download" else vgg16}


def upgraded_reconstruction(written: Any) -> Any:
    """Return the values of a reconstruction's recipe in today's format, as `upgraded` does.

    Until November 2026 all rates of learning fell to the same fraction, the scene had no config, and all
    tracks were actors.
    """
    written = _renamed(written, "schedule", most_gaussians="max_gaussians")
    written = _renamed(written, "initial", actor_points_most="max_actor_points")
    schedule = written.get("schedule") if isinstance(written, Mapping) else None
    rates = schedule.get("rates") if isinstance(schedule, Mapping) else None
    if isinstance(schedule, Mapping) and isinstance(rates, Mapping):
        written = {**written, "schedule": {**schedule, "rates": _with_own_finals(rates)}}
    if isinstance(written, Mapping) and written.keys() & {"decoder_width", "rolling"}:
        decoder = {"width": written.get("decoder_width", 32)}
        kept = {key: value for key, value in written.items() if key not in ("decoder_width", "rolling")}
        written = {**kept, "scene": {"decoder": decoder, "rolling": written.get("rolling", True)}}
    written = _with_representation(written)
    if isinstance(written, Mapping) and "representation" in written and "moves_m" not in written:
        written = {**written, "moves_m": 0.0, "nonrigid": True}
    return written


def _with_representation(written: Any) -> Any:
    """Convert a recipe from when the only representation was Gaussians, whose parts stood beside the rest."""
    parts = ("initial", "schedule", "scene")
    if not isinstance(written, Mapping) or "representation" in written or "schedule" not in written:
        return written
    gaussians = {key: written[key] for key in parts if key in written} | {"kind": "gaussians"}
    return {key: value for key, value in written.items() if key not in parts} | {"representation": gaussians}


def _with_own_finals(rates: Mapping[str, Any]) -> dict[str, Any]:
    """Give each rate of learning its own final fraction."""
    finals = {"mean_m": rates.get("final_mean", 0.01)}
    return {
        name: rate
        if isinstance(rate, Mapping)
        else {"first": rate, "final": finals.get(name, rates.get("final", 0.1))}
        for name, rate in rates.items()
        if name not in ("final", "final_mean")
    }


_FLAT_PARTS = {"plane", "observation_hidden", "expanded", "volume_hidden", "statics", "prompt"}


def _with_module_configs(written: Mapping[str, Any]) -> Any:
    """Convert the first nested format. DriveWorld's parts had no configs, and entries had other names."""
    model = dict(written["model"])
    if model.get("unseen") == "zero":  # what comes into view has a feature of 0, without an option
        del model["unseen"]
    if model.keys() >= _FLAT_PARTS:
        model["plane_channels"] = model.pop("plane")
        model["to_vector"] = {"hidden": model.pop("observation_hidden")}
        model["from_vector"] = {"widths": model.pop("expanded")}
        model["to_volume"] = {"hidden": model.pop("volume_hidden")}
        model["statics"] = {"channels": model["statics"]} if model["statics"] else None
        prompt = model["prompt"]
        if isinstance(prompt, Mapping) and "widths" in prompt:
            rest = {key: value for key, value in prompt.items() if key != "widths"}
            model["prompt"] = {"expand": {"widths": prompt["widths"]}, **rest}
    written = _renamed({**written, "model": model}, "model", carry_statics="warp_statics")
    planner = _renamed(written.get("planner"), "path", aside_m="lateral_m")
    written = {**written, "planner": planner} if "planner" in written else written
    if isinstance(clips := written.get("clips"), Mapping) and clips.get("future_source") == "taught":
        return {**written, "clips": {**clips, "future_source": "expert"}}
    return written


def _renamed(written: Any, part: str, **names: str) -> Any:
    """Return values with other names for some entries of a part. Anything else is returned unchanged."""
    entries = written.get(part) if isinstance(written, Mapping) else None
    if not isinstance(entries, Mapping):
        return written
    return {**written, part: {names.get(key, key): value for key, value in entries.items()}}


def _nested(written: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the flat format to the nested one.

    Until November 2026 `model` held the sizes of the planner and of all parts side by side. NeMo and its
    stages had no `kind`, and some numbers were fixed in the code.
    """
    flat = dict(written["model"])
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
