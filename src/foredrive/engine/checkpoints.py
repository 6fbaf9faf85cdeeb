"""Checkpoints as safetensors, written atomically."""

import json
import logging
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim import Optimizer

from foredrive.engine.parts import placed_like, whole
from foredrive.engine.small_weights import full_precision
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


def load_weights(model: nn.Module, path: Path, part: str = "") -> None:
    """Load weights into a model of the same architecture, from `save_weights` or `save_small`.

    Args:
        part: prefix of the model in the file, such as "world_model"; "" is the whole file.

    Raises:
        InputError: the file cannot be read or is of another architecture.
    """
    prefix = f"{part}." if part else ""
    try:
        saved = full_precision(load_file(path))
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: weights cannot be read: {error}") from error
    state = {name.removeprefix(prefix): value for name, value in saved.items() if name.startswith(prefix)}
    own = model.state_dict()
    # Names that only one side has, then names with different shapes
    wrong = sorted(set(own) ^ set(state)) + [
        name for name in sorted(set(own) & set(state)) if own[name].shape != state[name].shape
    ]
    if wrong:
        raise InputError(f"{path}: weights of another architecture: {wrong[0]} ({len(wrong)} entries differ)")
    model.load_state_dict({name: placed_like(value, own[name]) for name, value in state.items()})


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
        placed = placed_like(value, own) if value.shape == own.shape else value
        state.setdefault(int(index), {})[name] = placed
    optimizer.load_state_dict({"state": state, "param_groups": scalars["param_groups"]})
