"""Gaussians as PLY files for viewers of 3-D Gaussians (Kerbl et al., 2023)."""

from pathlib import Path

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from plyfile import PlyData, PlyElement

from foredrive.files import atomic_path
from foredrive.rendering.gaussians import Gaussians

SH_DEGREE_0 = 0.28209479177387814
"""Albedo is 0.5 plus this factor times the constant coefficient."""
_COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write centres, rotations, scales, opacities and albedo. The file cannot hold the effect of decoders."""
    gaussians = gaussians.map_tensors(lambda tensor: tensor.detach().cpu())
    columns = [
        gaussians.mean_m,
        torch.zeros_like(gaussians.mean_m),
        (gaussians.feature[:, :3] - 0.5) / SH_DEGREE_0,
        gaussians.opacity_logit[:, None],
        gaussians.log_scale,
        torch.nn.functional.normalize(gaussians.quaternion, dim=-1),
    ]
    table = torch.cat(columns, dim=-1).numpy()
    rows = unstructured_to_structured(table, np.dtype([(name, "<f4") for name in _COLUMNS]))
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(temporary)
