"""Fabric for training, with mixed precision that does not change the inputs."""

from typing import Any, Literal

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins import MixedPrecision

from foredrive.ops.precision import computes_bfloat16


class _Autocast(MixedPrecision):
    """Mixed precision without conversion of inputs.

    Fabric's own converts all inputs (focal lengths, poses) to half precision, or fails on frozen records.
    """

    def convert_input(self, data: Any) -> Any:
        return data


def make_fabric(precision: Literal["32-true", "bf16-mixed"]) -> Fabric:
    """Return a Fabric on all available GPUs or the CPU.

    "bf16-mixed" uses bfloat16 autocast, unless that would be slower.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    mixed = precision == "bf16-mixed" and computes_bfloat16(device)
    return Fabric(
        accelerator=device,
        devices="auto" if device == "cuda" else 1,
        plugins=[_Autocast("bf16-mixed", device)] if mixed else [],
    )
