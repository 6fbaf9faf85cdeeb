"""Fabric as training wants it: mixed precision that leaves the inputs alone."""

from typing import Any, Literal

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins import MixedPrecision

from foredrive.ops.precision import computes_bfloat16


class _Autocast(MixedPrecision):
    """Fabric's own rounds all inputs (focal lengths, poses) to half precision, or fails on frozen records."""

    def convert_input(self, data: Any) -> Any:
        return data


def make_fabric(precision: Literal["32-true", "bf16-mixed"]) -> Fabric:
    """All GPUs there are, or the CPU; "bf16-mixed" runs what autocast knows in bfloat16, unless that would
    take longer."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    mixed = precision == "bf16-mixed" and computes_bfloat16(device)
    return Fabric(
        accelerator=device,
        devices="auto" if device == "cuda" else 1,
        plugins=[_Autocast("bf16-mixed", device)] if mixed else [],
    )
