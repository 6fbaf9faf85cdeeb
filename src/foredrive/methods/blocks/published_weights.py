"""Published weights of image networks, read from local files."""

from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from foredrive.errors import InputError


def load_published(module: nn.Module, path: Path, name: str) -> None:
    """Load a .safetensors or .pth file into a module, freeze it, and put it in evaluation mode.

    Entries that the module does not have, such as a classifier's, are ignored. A .pth file may hold tensors
    only; nothing else in it is read.

    Args:
        name: name of the network in messages.

    Raises:
        InputError: there is no such file, it cannot be read, or it holds other weights.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file of {name} weights")
    try:
        if path.suffix == ".safetensors":
            state = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, SafetensorError, UnpicklingError, EOFError) as error:
        raise InputError(f"{path}: not {name} weights: {str(error).splitlines()[0]}") from error
    load_state(module, state, str(path), name)


def load_state(module: nn.Module, state: Mapping[str, Tensor], source: str, name: str) -> None:
    """Load a state dict as `load_published` does; `source` stands for the file in messages."""
    # Scalars such as batch norm's counter are not needed
    wanted = {key: value for key, value in module.state_dict().items() if value.dim()}  # no counters
    for key, value in wanted.items():
        if key not in state:
            raise InputError(f"{source}: not {name} weights, lacks {key}")
        if state[key].shape != value.shape:
            shapes = f"{tuple(state[key].shape)} instead of {tuple(value.shape)}"
            raise InputError(f"{source}: not {name} weights, {key} is {shapes}")
    module.load_state_dict({key: state[key] for key in wanted}, strict=False)
    module.requires_grad_(False)
    module.eval()
