"""The emulated card: what PyTorch does with a tensor on a CUDA device, computed on the CPU.

To be imported after `emulation.start`; `begin` then changes PyTorch for the whole process. Of processes that
torchrun started, each has a card of its own; without it, the card is cuda:0.
"""

import contextlib
import os
from collections.abc import Callable
from typing import Any

import torch
from emulation import TO_CARD, TO_HOST, WAIT, Counts
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

aten = torch.ops.aten
CARD, COUNTS = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))), Counts()
CARDS = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))

INDEXING = {
    *(aten.index.Tensor, aten._unsafe_index.Tensor, aten.index_put.default, aten.index_put_.default),
    aten._index_put_impl_.default,
}
ACROSS = {aten.copy_.default, aten._to_copy.default}
# The number of their results depends on values, so the host waits for them
WAITING = {
    *(aten._local_scalar_dense.default, aten.nonzero.default, aten.masked_select.default),
    *(aten._unique2.default, aten.unique_dim.default, aten.unique_consecutive.default),
    *(aten.equal.default, aten.bincount.default, aten.repeat_interleave.Tensor),
}


class OnCard(Tensor):
    """A tensor on the emulated card. `values` are on the CPU."""

    values: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls: type, values: Tensor, requires_grad: bool = False) -> "OnCard":
        made = Tensor._make_wrapper_subclass(
            cls,
            values.size(),
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
            device=CARD,
            requires_grad=requires_grad,
        )
        made.values = values
        return made  # type: ignore[return-value]

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"OnCard({self.values!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})

    def __reduce_ex__(self, protocol: Any) -> Any:
        return _restored, (OnCard, self.detach().values.clone(), self.requires_grad)

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        if id(self) not in memo:
            copy = self.detach().clone()
            kind = torch.nn.Parameter if isinstance(self, torch.nn.Parameter) else torch.Tensor.requires_grad_
            memo[id(self)] = kind(copy, self.requires_grad)
        return memo[id(self)]

    def untyped_storage(self) -> Any:  # type: ignore[override]
        return self.detach().values.untyped_storage()

    def data_ptr(self) -> int:
        return self.detach().values.data_ptr()

    def tolist(self) -> Any:
        COUNTS.note(WAIT)
        return self.detach().values.tolist()


def tensors(values: Any) -> list[Tensor]:
    return [value for value in tree_flatten(values)[0] if isinstance(value, Tensor)]


def _is_on_card(value: object) -> bool:
    return isinstance(value, OnCard)


def device_of(func: Any, args: Any, kwargs: Any, is_on_card: Callable[[object], bool] = _is_on_card) -> bool:
    """Return whether an operation runs on the card; raise where CUDA does."""
    if func in ACROSS:
        return any(is_on_card(value) for value in tensors((args, kwargs)))
    judged = tensors((args, kwargs))
    if func in INDEXING:
        # An index on the host may read a tensor of the card, but not the other way round
        indices = tensors(args[1])
        if not is_on_card(args[0]) and any(is_on_card(index) for index in indices):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
            )
        if is_on_card(args[0]) and any(not is_on_card(index) for index in indices):
            COUNTS.note(TO_CARD)
        judged = tensors((args[0], args[2:]))
    # Numbers of the host may join tensors of the card; other tensors may not
    on_card = [is_on_card(value) for value in judged]
    numbers = [value.device.type == "cpu" and value.dim() == 0 for value in judged]
    if any(on_card) and not all(card or number for card, number in zip(on_card, numbers, strict=True)):
        shapes = [(tuple(value.shape), value.device.type) for value in judged]
        raise RuntimeError(f"{func}: expected all tensors to be on the same device, but found {shapes}")
    return any(on_card)


def compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    on_card = device_of(func, args, kwargs)
    wanted = kwargs.get("device")
    to_card = on_card if wanted is None else torch.device(wanted).type == "cuda"
    generator = kwargs.get("generator") or next((a for a in args if isinstance(a, torch.Generator)), None)
    if generator is not None and to_card != (generator.device.type == "cuda"):
        raise RuntimeError(f"{func}: expected a {'cuda' if to_card else 'cpu'} device type for generator")
    if func is aten.is_pinned.default:
        return False
    if func is aten._pin_memory.default:
        return args[0]
    _count(func, args, on_card, to_card)
    # The CPU computes: the values go in, and the results are wrapped again
    given = dict(kwargs)
    if wanted is not None and torch.device(wanted).type == "cuda":
        given["device"] = torch.device("cpu")
    if given.get("pin_memory"):
        given["pin_memory"] = False
    owners = {id(value.values): value for value in tensors((args, kwargs)) if isinstance(value, OnCard)}
    with torch._C._DisableTorchDispatch():
        out = func(*tree_map(on_host, args), **tree_map(on_host, given))

    def returned(value: Any) -> Any:
        if not isinstance(value, Tensor) or isinstance(value, OnCard):
            return value
        # What an operation has changed in place is still the tensor that was given
        if id(value) in owners:
            return owners[id(value)]
        return OnCard(value) if to_card else value

    changed = any(arg.alias_info is not None and arg.alias_info.is_write for arg in func._schema.arguments)
    if changed and any(owner.shape != owner.values.shape for owner in owners.values()):
        raise NotImplementedError(f"{func} changes the shape of a tensor in place")
    return tree_map(returned, out)


def on_host(value: Any) -> Any:
    return value.values if isinstance(value, OnCard) else value


def _count(func: Any, args: Any, on_card: bool, to_card: bool) -> None:
    by_mask = func in INDEXING and any(index.dtype in (torch.bool, torch.uint8) for index in tensors(args[1]))
    if (func in WAITING and on_card) or (
        by_mask and on_card and (func is aten.index.Tensor or args[2].numel() > 1)
    ):
        COUNTS.note(WAIT)
    if func is aten._to_copy.default and to_card != isinstance(args[0], OnCard):
        COUNTS.note(TO_CARD if to_card else TO_HOST)
    if func is aten.copy_.default and isinstance(args[0], OnCard) != isinstance(args[1], OnCard):
        COUNTS.note(TO_CARD if isinstance(args[0], OnCard) else TO_HOST)


class Emulation(TorchDispatchMode):
    """Operations without a tensor of the card, such as those that make one."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})


plain_generator = torch.Generator


class Generator(plain_generator):  # type: ignore[misc,valid-type]
    """A generator that knows its device; numbers come from the CPU's."""

    def __new__(cls, device: Any = "cpu") -> "Generator":
        made = plain_generator.__new__(cls, "cpu")
        made.on = CARD if torch.device(device).type == "cuda" else torch.device("cpu")
        return made  # type: ignore[no-any-return]

    @property
    def device(self) -> torch.device:
        return self.on  # type: ignore[attr-defined,no-any-return]


class Properties:
    """Describes the card."""

    name, major, minor, total_memory, multi_processor_count = "emulated", 9, 0, 80 * 2**30, 132


ANSWERS: dict[str, Any] = {
    **dict.fromkeys(("is_available", "is_initialized", "is_bf16_supported"), True),
    **dict.fromkeys(("_lazy_init", "set_device", "synchronize", "empty_cache", "init"), None),
    **dict.fromkeys(("reset_peak_memory_stats", "manual_seed", "manual_seed_all"), None),
    **dict.fromkeys(("get_rng_state", "set_rng_state", "set_rng_state_all"), None),
    **{"device_count": CARDS, "current_device": CARD.index, "max_memory_allocated": 0, "memory_allocated": 0},
    **{"is_current_stream_capturing": False, "get_device_name": "emulated"},
    **{"get_device_properties": Properties(), "get_device_capability": (9, 0)},
    "get_rng_state_all": [],
    "mem_get_info": (70 * 2**30, 80 * 2**30),
}
"""What `torch.cuda` answers."""


def begin() -> Counts:
    """Begin the emulation in this process; return what it counts."""
    for name, answer in ANSWERS.items():
        setattr(torch.cuda, name, lambda *_, answer=answer, **__: answer)
    torch.Generator = Generator  # type: ignore[misc,assignment]
    # Tensors of inference mode cannot be wrapped
    torch.inference_mode = lambda mode=True: torch.no_grad() if mode else contextlib.nullcontext()  # type: ignore
    # Its fused kernel exists on cards alone
    torch.nn.GRUCell.forward = _gru_cell  # type: ignore[method-assign,assignment]
    # Without these, a parameter keeps the storage of the CPU, and `torch.tensor(…, device="cuda")` fails
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    torch._C._set_only_lift_cpu_tensors(True)
    Emulation().__enter__()
    return COUNTS


def _gru_cell(self: Any, x: Any, hidden: Any) -> Any:
    """Compute a step of a GRU (the equations of `torch.nn.GRUCell`)."""
    linear = torch.nn.functional.linear
    reset_x, update_x, new_x = linear(x, self.weight_ih, self.bias_ih).chunk(3, -1)
    reset_h, update_h, new_h = linear(hidden, self.weight_hh, self.bias_hh).chunk(3, -1)
    update = (update_x + update_h).sigmoid()
    new = (new_x + (reset_x + reset_h).sigmoid() * new_h).tanh()
    return new + update * (hidden - new)


def _restored(kind: Any, values: Any, requires_grad: bool) -> Any:
    return kind(values).requires_grad_(requires_grad)
