"""Checkpoints as safetensors, written atomically; in 8 bits, a quarter of their size, for shipped models."""

import json
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int8
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.engine.parts import placed_like, whole
from foredrive.errors import InputError
from foredrive.files import atomic_path

_log = logging.getLogger(__name__)
MODEL, OPTIMIZER, PROGRESS = "model.safetensors", "optimizer.safetensors", "progress.json"


def save_checkpoint(
    folder: Path, model: nn.Module, optimizer: Optimizer, step: int, *, writes: bool = True
) -> Path:
    """Write `folder/step_N` and then remove older checkpoints.

    Exact resuming needs only the model's weights, the optimizer's tensors and the step number. Data order and
    random numbers follow from the seed and the step.

    Where processes hold shards, all of them have to call this, and one writes. The checkpoint is the same as
    that of one process.
    """
    final = folder / f"step_{step:07d}"
    # Gathering shards is a collective operation: every process takes part before the others leave
    weights, (tensors, scalars) = whole_weights(model), _flatten_optimizer(optimizer)
    if not writes:
        return final
    with atomic_path(final) as temporary:
        temporary.mkdir()
        save_file(weights, temporary / MODEL)
        save_file(tensors, temporary / OPTIMIZER)
        (temporary / PROGRESS).write_text(json.dumps({"step": step, "optimizer": scalars}))
    # The new checkpoint is complete on disk, so at every moment there is one to resume from
    remove_older(final)
    _log.info("saved %s", final)
    return final


def remove_older(checkpoint: Path) -> None:
    """Remove the other checkpoints in its folder. Resuming repeats this, in case that it was cut short."""
    for old in checkpoint.parent.glob("step_*"):
        if old != checkpoint:
            shutil.rmtree(old)


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the checkpoint with the highest step, or None."""
    return max(folder.glob("step_*"), default=None)


def load_checkpoint(path: Path, model: nn.Module, optimizer: Optimizer) -> int:
    """Restore model and optimizer. Return the number of finished steps.

    Raises:
        InputError: the checkpoint cannot be read, is of another architecture, or has other groups of
            parameters.
    """
    load_weights(model, path / MODEL)
    try:
        progress = json.loads((path / PROGRESS).read_text())
        tensors = load_file(path / OPTIMIZER)
    except (OSError, ValueError, RecursionError, SafetensorError) as error:
        raise InputError(f"{path}: checkpoint cannot be read: {error}") from error
    try:
        _restore_optimizer(optimizer, tensors, progress["optimizer"])
    except ValueError as error:
        raise InputError(
            f"{path}: checkpoint of an earlier version, {error}; train this stage anew"
        ) from error
    return int(progress["step"])


def whole_weights(model: nn.Module) -> dict[str, Tensor]:
    """Return all parameters and buffers of a model by name; shards of several processes are put together."""
    return {name: whole(tensor.detach()).contiguous() for name, tensor in model.state_dict().items()}


def save_weights(model: nn.Module, path: Path) -> None:
    """Write all parameters and buffers of a model as safetensors."""
    save_file(whole_weights(model), path)


def load_weights(model: nn.Module, path: Path, part: str = "", fresh: tuple[str, ...] = ()) -> None:
    """Load weights into a model of the same architecture, from `save_weights` or `save_small`.

    Args:
        part: prefix of the model in the file, such as "world_model"; "" is the whole file.
        fresh: prefixes of parts that keep their weights if the file lacks them.

    Raises:
        InputError: the file cannot be read or is of another architecture.
    """
    prefix = f"{part}." if part else ""
    try:
        saved = full_precision(load_file(path))
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: weights cannot be read: {error}") from error
    state = {name.removeprefix(prefix): value for name, value in saved.items() if name.startswith(prefix)}
    kept = tuple(start for start in fresh if not any(name.startswith(start) for name in state))
    own = {name: value for name, value in model.state_dict().items() if not name.startswith(kept)}
    # Names that only one side has, then names with different shapes
    wrong = sorted(set(own) ^ set(state)) + [
        name for name in sorted(set(own) & set(state)) if own[name].shape != state[name].shape
    ]
    if wrong:
        raise InputError(f"{path}: weights of another architecture: {wrong[0]} ({len(wrong)} entries differ)")
    model.load_state_dict(
        {name: placed_like(value, own[name]) for name, value in state.items()}, strict=not kept
    )


def _flatten_optimizer(optimizer: Optimizer) -> tuple[dict[str, Tensor], dict[str, Any]]:
    state = optimizer.state_dict()
    tensors = {
        # Keys are PARAMETER.ENTRY, the parameter as its index over all groups
        f"{index}.{name}": whole(value).contiguous()
        for index, entry in state["state"].items()
        for name, value in entry.items()
    }
    return tensors, {"param_groups": state["param_groups"]}


def _restore_optimizer(optimizer: Optimizer, tensors: dict[str, Tensor], scalars: dict[str, Any]) -> None:
    """Restore an optimizer.

    Raises:
        ValueError: it had other groups of parameters.
    """
    sizes = [
        [len(group["params"]) for group in groups]
        for groups in (optimizer.param_groups, scalars["param_groups"])
    ]
    if sizes[0] != sizes[1]:
        raise ValueError(f"whose optimizer has groups of {sizes[1]} parameters, not of {sizes[0]}")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        own = parameters[int(index)]
        # Moments are sharded as their parameter is. The count of steps is a scalar, which is not sharded
        if value.shape == own.shape:
            # Fused Adam (PyTorch 2.13) takes their numbers to lie in the order of the parameter's
            value = torch.empty_like(own, dtype=value.dtype).copy_(placed_like(value, own))
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({"state": state, "param_groups": scalars["param_groups"]})


SCALE = ".scale"
"""Suffix of the scales of a tensor in 8 bits."""
LEVELS = 127


def save_small(model: nn.Module, path: Path) -> None:
    """Write a model's weights: matrices and filters in 8 bits, all other floating-point values in 16.

    Each row (output channel) of a matrix or filter has a scale of its own, so no value changes by more than
    1/254 of the largest in its row. `load_weights` reads such files too.
    """
    entries: dict[str, Tensor] = {}
    for name, value in model.state_dict().items():
        if value.is_floating_point() and value.dim() > 1:
            entries[name], entries[name + SCALE] = _in_8_bits(value.detach())
        # Values beyond the range of float16 stay in 32 bits
        elif value.is_floating_point() and value.abs().max() < torch.finfo(torch.float16).max:
            entries[name] = value.detach().half().contiguous()
        else:
            entries[name] = value.detach().contiguous()
    save_file(entries, path)


def _in_8_bits(value: Float[Tensor, "..."]) -> tuple[Int8[Tensor, "..."], Float[Tensor, "..."]]:
    rows = value.float().flatten(1)
    # A row of zeros gets a tiny scale instead of a division by zero
    scale = rows.abs().amax(1, keepdim=True).clamp_min(1e-12) / LEVELS
    codes = (rows / scale).round_().to(torch.int8).view(value.shape)
    return codes.contiguous(), scale.view(-1, *[1] * (value.dim() - 1)).contiguous()


def full_precision(saved: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return 8-bit weights of a file as 32-bit values. All other weights are returned unchanged."""
    return {
        name: value.float() * saved[name + SCALE] if name + SCALE in saved else value
        for name, value in saved.items()
        if not name.endswith(SCALE)
    }
