"""An emulated CUDA device: tensors that say they are on cuda:0, obey CUDA's rules and compute on the CPU.

A program that mixes devices, reads a tensor of the card into NumPy or draws random numbers with a generator
of the CPU fails here as it fails on a card. Values are those of the CPU, so both devices can be compared.
Copies between the devices, and operations for which the host waits, are counted by the line that asks.

`start` changes PyTorch for the whole process, so each program runs in a process of its own. It has to be
called before PyTorch is imported for the first time.
"""

import collections
import contextlib
import ctypes
import hashlib
import importlib.util
import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

HOOKS = Path(__file__).with_name("hooks.cpp")
PACKAGE = f"{os.sep}foredrive{os.sep}"


def built_hooks(folder: Path) -> Path:
    """Compile the answers of the device against the installed PyTorch, unless they are there."""
    (torch,) = importlib.util.find_spec("torch").submodule_search_locations  # type: ignore[union-attr]
    version = Path(torch, "version.py").read_bytes() + sysconfig.get_platform().encode()
    digest = hashlib.sha256(HOOKS.read_bytes() + version).hexdigest()[:16]
    built = folder / f"cuda_hooks_{digest}.so"
    if not built.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        scratch = built.with_suffix(f".{os.getpid()}")
        command = ["g++", "-O0", "-shared", "-fPIC", "-std=c++20", f"-I{torch}/include", str(HOOKS)]
        subprocess.run([*command, "-o", str(scratch)], check=True, capture_output=True)
        scratch.replace(built)
    return built


def start(hooks: Path) -> "Counts":
    """Begin the emulation in this process; return what it counts."""
    assert "torch" not in sys.modules, "the hooks are registered before PyTorch starts"
    (torch,) = importlib.util.find_spec("torch").submodule_search_locations  # type: ignore[union-attr]
    for name in ("libc10.so", "libtorch_cpu.so"):
        ctypes.CDLL(f"{torch}/lib/{name}", ctypes.RTLD_GLOBAL)
    ctypes.CDLL(str(hooks))
    return _begin()


class Counts:
    """Waits of the host and copies between the devices, by their kind and the line of the package."""

    def __init__(self) -> None:
        self.by_line: collections.Counter[tuple[str, str]] = collections.Counter()

    def note(self, kind: str) -> None:
        """Count one."""
        frame = sys._getframe(1)
        while frame is not None and PACKAGE not in frame.f_code.co_filename:
            frame = frame.f_back  # type: ignore[assignment]
        line = "elsewhere"
        if frame is not None:
            line = f"{frame.f_code.co_filename.rpartition(PACKAGE)[2]}:{frame.f_lineno}"
        self.by_line[kind, line] += 1

    def of(self, kind: str) -> int:
        """Return how many of a kind there were."""
        return sum(count for (this, _), count in self.by_line.items() if this == kind)


WAIT, TO_CARD, TO_HOST = "wait", "copy to the card", "copy to the host"


def _begin() -> Counts:
    import torch
    from torch import Tensor
    from torch.utils._python_dispatch import TorchDispatchMode
    from torch.utils._pytree import tree_flatten, tree_map

    aten, card, counts = torch.ops.aten, torch.device("cuda", 0), Counts()
    indexing = {
        *(aten.index.Tensor, aten._unsafe_index.Tensor, aten.index_put.default, aten.index_put_.default),
        aten._index_put_impl_.default,
    }
    across = {aten.copy_.default, aten._to_copy.default}
    # The number of their results depends on values, so the host waits for them
    waiting = {
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
                device=card,
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
                kind = (
                    torch.nn.Parameter
                    if isinstance(self, torch.nn.Parameter)
                    else torch.Tensor.requires_grad_
                )
                memo[id(self)] = kind(copy, self.requires_grad)
            return memo[id(self)]

        def untyped_storage(self) -> Any:  # type: ignore[override]
            return self.detach().values.untyped_storage()

        def data_ptr(self) -> int:
            return self.detach().values.data_ptr()

        def tolist(self) -> Any:
            counts.note(WAIT)
            return self.detach().values.tolist()

    def tensors(values: Any) -> list[Tensor]:
        return [value for value in tree_flatten(values)[0] if isinstance(value, Tensor)]

    def device_of(func: Any, args: Any, kwargs: Any) -> bool:
        """Return whether an operation runs on the card; raise where CUDA does."""
        if func in across:
            return any(isinstance(value, OnCard) for value in tensors((args, kwargs)))
        judged = tensors((args, kwargs))
        if func in indexing:
            # An index on the host may read a tensor of the card, but not the other way round
            indices = tensors(args[1])
            if not isinstance(args[0], OnCard) and any(isinstance(index, OnCard) for index in indices):
                raise RuntimeError(
                    "indices should be either on cpu or on the same device as the indexed tensor (cpu)"
                )
            if isinstance(args[0], OnCard) and any(not isinstance(index, OnCard) for index in indices):
                counts.note(TO_CARD)
            judged = tensors((args[0], args[2:]))
        # Numbers of the host may join tensors of the card; other tensors may not
        on_card = [isinstance(value, OnCard) for value in judged]
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

        changed = any(
            arg.alias_info is not None and arg.alias_info.is_write for arg in func._schema.arguments
        )
        if changed and any(owner.shape != owner.values.shape for owner in owners.values()):
            raise NotImplementedError(f"{func} changes the shape of a tensor in place")
        return tree_map(returned, out)

    def on_host(value: Any) -> Any:
        return value.values if isinstance(value, OnCard) else value

    def _count(func: Any, args: Any, on_card: bool, to_card: bool) -> None:
        by_mask = func in indexing and any(
            index.dtype in (torch.bool, torch.uint8) for index in tensors(args[1])
        )
        if (func in waiting and on_card) or (
            by_mask and on_card and (func is aten.index.Tensor or args[2].numel() > 1)
        ):
            counts.note(WAIT)
        if func is aten._to_copy.default and to_card != isinstance(args[0], OnCard):
            counts.note(TO_CARD if to_card else TO_HOST)
        if func is aten.copy_.default and isinstance(args[0], OnCard) != isinstance(args[1], OnCard):
            counts.note(TO_CARD if isinstance(args[0], OnCard) else TO_HOST)

    class Emulation(TorchDispatchMode):
        """Operations without a tensor of the card, such as those that make one."""

        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            return compute(func, args, kwargs or {})

    plain_generator = torch.Generator

    class Generator(plain_generator):  # type: ignore[misc,valid-type]
        """A generator that knows its device; numbers come from the CPU's."""

        def __new__(cls, device: Any = "cpu") -> "Generator":
            made = plain_generator.__new__(cls, "cpu")
            made.on = card if torch.device(device).type == "cuda" else torch.device("cpu")
            return made  # type: ignore[no-any-return]

        @property
        def device(self) -> torch.device:
            return self.on  # type: ignore[attr-defined,no-any-return]

    class Properties:
        """What a card says of itself."""

        name, major, minor, total_memory, multi_processor_count = "emulated", 9, 0, 80 * 2**30, 132

    cuda: Any = torch.cuda
    answers: dict[str, Any] = {
        **dict.fromkeys(("is_available", "is_initialized", "is_bf16_supported"), True),
        **dict.fromkeys(("_lazy_init", "set_device", "synchronize", "empty_cache", "init"), None),
        **dict.fromkeys(("reset_peak_memory_stats", "manual_seed", "manual_seed_all"), None),
        **dict.fromkeys(("get_rng_state", "set_rng_state", "set_rng_state_all"), None),
        **{"device_count": 1, "current_device": 0, "max_memory_allocated": 0, "memory_allocated": 0},
        **{"is_current_stream_capturing": False, "get_device_name": "emulated"},
        **{"get_device_properties": Properties(), "get_device_capability": (9, 0)},
        "get_rng_state_all": [],
        "mem_get_info": (70 * 2**30, 80 * 2**30),
    }
    for name, answer in answers.items():
        setattr(cuda, name, lambda *_, answer=answer, **__: answer)
    torch.Generator = Generator  # type: ignore[misc,assignment]
    # Tensors of inference mode cannot be wrapped
    torch.inference_mode = lambda mode=True: torch.no_grad() if mode else contextlib.nullcontext()  # type: ignore
    # Its fused kernel exists on cards alone
    torch.nn.GRUCell.forward = _gru_cell  # type: ignore[method-assign,assignment]
    # Without these, a parameter keeps the storage of the CPU, and `torch.tensor(…, device="cuda")` fails
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    torch._C._set_only_lift_cpu_tensors(True)
    Emulation().__enter__()
    return counts


def _gru_cell(self: Any, x: Any, hidden: Any) -> Any:
    """Compute a step of a GRU (the equations of `torch.nn.GRUCell`)."""
    from torch.nn.functional import linear

    reset_x, update_x, new_x = linear(x, self.weight_ih, self.bias_ih).chunk(3, -1)
    reset_h, update_h, new_h = linear(hidden, self.weight_hh, self.bias_hh).chunk(3, -1)
    update = (update_x + update_h).sigmoid()
    new = (new_x + (reset_x + reset_h).sigmoid() * new_h).tanh()
    return new + update * (hidden - new)


def _restored(kind: Any, values: Any, requires_grad: bool) -> Any:
    return kind(values).requires_grad_(requires_grad)
