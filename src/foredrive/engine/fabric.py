"""Fabric for training: devices, processes, and mixed precision that does not change the inputs."""

import os
import warnings
from datetime import timedelta
from typing import TYPE_CHECKING, Any, Literal

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins import MixedPrecision
from lightning_fabric.strategies import DDPStrategy, ModelParallelStrategy
from torch import nn

from foredrive.devices import DEVICE, chosen_device
from foredrive.engine.processes import processes_of_launcher
from foredrive.errors import InputError
from foredrive.ops.precision import computes_bfloat16

if TYPE_CHECKING:
    from torch.distributed.device_mesh import DeviceMesh

Sharing = Literal["ddp", "fsdp"]
"""How processes share a training. DDP: each holds all weights and the optimizer's state. FSDP: each holds a
shard of both, and has all weights only during a step."""
PATIENCE = timedelta(hours=2)
"""Time for which processes wait for work of the first process alone, such as fitting path features."""


class _Autocast(MixedPrecision):
    """Mixed precision without conversion of inputs.

    Fabric's own converts all inputs (focal lengths, poses) to half precision, or fails on frozen records.
    """

    def convert_input(self, data: Any) -> Any:
        return data


def make_fabric(precision: Literal["32-true", "bf16-mixed"], sharing: Sharing | None = None) -> Fabric:
    """Return a Fabric on the device of this process, see `chosen_device`.

    Args:
        precision: "bf16-mixed" uses bfloat16 autocast, unless that would be slower.
        sharing: use the processes that torchrun started, or all GPUs of this machine. None: one device.

    Raises:
        InputError: torchrun started more processes than this machine has GPUs.
    """
    device, _, number = chosen_device().partition(":")
    gpus = torch.cuda.device_count()
    # A device that is named is used alone, unless torchrun has started processes for all
    named = DEVICE in os.environ
    alone = (1, 1) if named else (1, max(1, gpus))
    machines, per_machine = (processes_of_launcher() or alone) if sharing else (1, 1)
    if 0 < gpus < per_machine:
        raise InputError(
            f"{per_machine} processes, but this machine has {gpus} GPUs: --nproc-per-node {gpus}"
        )
    mixed = precision == "bf16-mixed" and computes_bfloat16(device)
    if device == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32 in what stays in 32 bits
    return Fabric(
        accelerator=device,
        devices=[int(number)] if number and per_machine == 1 and machines == 1 else per_machine,
        num_nodes=machines,
        strategy=_strategy(sharing, machines * per_machine) if sharing else "auto",
        plugins=[_Autocast("bf16-mixed", device)] if mixed else [],
    )


def _strategy(sharing: Sharing, processes: int) -> DDPStrategy | ModelParallelStrategy | str:
    if processes == 1:
        return "auto"
    if sharing == "fsdp":
        return ModelParallelStrategy(
            _shard, data_parallel_size=processes, tensor_parallel_size=1, timeout=PATIENCE
        )
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
    warnings.filterwarnings("ignore", message="`broadcast_buffers` is deprecated")
    # Heads have no loss in batches without their truth, so some parameters may be unused in a step
    # `StepBuffers` averages the buffers, so DDP must not overwrite them with those of the first process
    return DDPStrategy(find_unused_parameters=True, broadcast_buffers=False, timeout=PATIENCE)


def _shard(module: nn.Module, mesh: "DeviceMesh") -> nn.Module:
    """Shard all parameters of a module over the processes (FSDP2), after making them those of the first.

    The module is one group: its parts are called by other methods than `forward`, before which FSDP would not
    gather their weights.
    """
    from torch.distributed.fsdp import fully_shard

    for tensor in (*module.parameters(), *module.buffers()):
        torch.distributed.broadcast(tensor.data, src=0)
    fully_shard(module, mesh=mesh["data_parallel"])  # changes the module itself
    return module
