"""Gaussians as PLY files for viewers of 3-D Gaussians (Kerbl et al., 2023)."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.lib.recfunctions import unstructured_to_structured
from plyfile import PlyData, PlyElement
from torch import Tensor

from foredrive.files import atomic_path
from foredrive.methods.splatad import Gaussians

SH_DEGREE_0 = 0.28209479177387814
"""Albedo is 0.5 plus this factor times the constant coefficient."""
_HIGHER = 3 * (4**2 - 1)
"""Number of coefficients of degrees 1 to 3. Some viewers open no other degree. Ours are 0."""
_COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{number}" for number in range(_HIGHER)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
_COMMENTS = [
    "opacity: logit, for renderers that lower it as they widen small splats by 0.3 px^2 (antialiased)",
    "colour: albedo alone, without the decoders; f_rest is 0",
    "axes: metres, z is up; viewers that take -y for up show it on its side until it is turned",
]
FAR = 4.0
"""Splats farther from the middle than so many times the distance that 90 % keep are left out: sky and stray
splats kilometres away, to which viewers would fit their camera."""


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write centres, rotations, scales, opacities and albedo. The file cannot hold the effect of decoders.

    Opacities assume compensation (`project_camera`): in viewers that widen small splats without it, far
    surfaces look denser and thin things thicker. Splats `FAR` beyond the others are left out, which a comment
    counts.
    """
    gaussians = gaussians.map_tensors(lambda tensor: tensor.detach().cpu())
    near = _near(gaussians.mean_m)
    left_out = f"left out: {int((~near).sum())} splats far beyond the others"
    gaussians = gaussians[near]
    columns = [
        gaussians.mean_m,
        torch.zeros_like(gaussians.mean_m),
        # PLY stores the coefficient of the constant spherical harmonic in place of albedo
        (gaussians.feature[:, :3] - 0.5) / SH_DEGREE_0,
        gaussians.mean_m.new_zeros(len(gaussians.mean_m), _HIGHER),
        gaussians.opacity_logit[:, None],
        gaussians.log_scale,
        torch.nn.functional.normalize(gaussians.quaternion, dim=-1),
    ]
    table = torch.cat(columns, dim=-1).numpy()
    rows = unstructured_to_structured(table, np.dtype([(name, "<f4") for name in _COLUMNS]))
    with atomic_path(path) as temporary:
        # The first published viewer reads the number of splats from the third line, so comments come later.
        vertices = PlyElement.describe(rows, "vertex", comments=[*_COMMENTS, left_out])
        PlyData([vertices], byte_order="<").write(temporary)


def _near(mean_m: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return which splats are part of the scene that 90 % of them make."""
    if not len(mean_m):
        return torch.zeros(0, dtype=torch.bool)
    distance_m = (mean_m - mean_m.median(dim=0).values).norm(dim=-1)
    # NumPy's quantile takes any number of values
    return distance_m <= FAR * float(np.quantile(distance_m.numpy(), 0.9))
