"""Processes with an emulated card each, which train together: collectives as NCCL has them, and DDP.

To be imported after `emulated_card`. Values are exchanged by gloo. DDP is PyTorch's own but for its reducer,
which is written in C++ and reads the memory of the card.
"""

import contextlib
from typing import Any

import torch
from emulated_card import OnCard, tensors
from torch import Tensor, distributed
from torch.nn.parallel import distributed as data_parallel

COLLECTIVES = ("all_reduce", "broadcast", "all_gather", "reduce_scatter", "all_gather_into_tensor")
plain = {name: getattr(distributed, name) for name in COLLECTIVES}
plain_start = distributed.init_process_group


def begin() -> None:
    """Begin in this process."""
    for name in COLLECTIVES:
        setattr(distributed, name, _of_cards(name))
    distributed.init_process_group = _start
    distributed.Reducer, distributed.Logger = Reducer, _Silent
    torch.cuda.Stream, torch.cuda.current_stream = _Silent, _Silent
    torch.cuda.stream = lambda _: contextlib.nullcontext()
    data_parallel._verify_param_shape_across_processes = lambda *_: None
    data_parallel._sync_module_states = _from_first


def _start(backend: str, **settings: Any) -> None:
    """Start the group as for cards. Objects are exchanged on the host."""
    if backend != "nccl":
        raise RuntimeError(f"processes with cards exchange by nccl, not by {backend}")
    settings.pop("device_id", None)
    plain_start("gloo", **settings)


def _of_cards(name: str) -> Any:
    def exchange(*args: Any, **kwargs: Any) -> Any:
        # NCCL refuses tensors of the host
        for value in tensors((args, kwargs)):
            if not isinstance(value, OnCard):
                raise RuntimeError(f"{name}: no backend type associated with device type cpu")
        host = torch.utils._pytree.tree_map(_values, (args, kwargs))
        return plain[name](*host[0], **host[1])

    return exchange


def _values(value: Any) -> Any:
    return value.detach().values if isinstance(value, OnCard) else value


def _from_first(module: torch.nn.Module, *_: object, **__: object) -> None:
    for value in (*module.parameters(), *module.buffers()):
        distributed.broadcast(value.data, src=0)


class _Silent:
    """Answers every call with None."""

    def __init__(self, *_: object) -> None: ...

    def __getattr__(self, name: str) -> Any:
        return lambda *_: None


class Reducer(_Silent):
    """Averages gradients over the processes at the end of a backward pass; no gradient counts as zero."""

    def __init__(self, parameters: list[Tensor], *_: object) -> None:
        self.parameters, self.awaited = parameters, False
        for parameter in parameters:
            parameter.register_post_accumulate_grad_hook(self._begin)

    def prepare_for_backward(self, _: object) -> None:
        self.awaited = True

    def _begin(self, _: Tensor) -> None:
        if self.awaited:
            self.awaited = False
            torch.autograd.Variable._execution_engine.queue_callback(self._average)

    def _average(self) -> None:
        # Autograd calls this outside the emulation, so it works on the values
        used = torch.tensor([p.grad is not None for p in self.parameters], dtype=torch.float32)
        plain["all_reduce"](used)
        for parameter, users in zip(self.parameters, used.tolist(), strict=True):
            if users:
                if parameter.grad is None:
                    parameter.grad = OnCard(torch.zeros_like(parameter.detach().values))
                gradient = parameter.grad.detach().values
                plain["all_reduce"](gradient)
                gradient /= distributed.get_world_size()
