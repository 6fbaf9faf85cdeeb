"""Gaussians as files that viewers read."""

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from test_scene_graph import graph_of, two_actors

from foredrive.rendering.ply import SH_DEGREE_0, write_ply
from foredrive.rendering.scene_graph import STATIC

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def test_a_file_holds_what_viewers_look_for(tmp_path: Path) -> None:
    gaussians = graph_of([[1.0, 2, 3], [4.0, 5, 6]], [STATIC, STATIC], two_actors()).gaussians
    write_ply(gaussians, tmp_path / "scene.ply")
    header = ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    header += [*(f"property float {name}" for name in NAMES), "end_header\n"]
    content = (tmp_path / "scene.ply").read_bytes()
    assert content.startswith("\n".join(header).encode())
    assert len(content) == len("\n".join(header)) + 2 * 4 * len(NAMES)

    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"]

    def column(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1))

    assert torch.equal(column("x", "y", "z"), gaussians.mean_m)
    assert torch.equal(column("scale_0", "scale_1", "scale_2"), gaussians.log_scale)
    assert torch.equal(column("opacity")[:, 0], gaussians.opacity_logit)
    albedo = 0.5 + SH_DEGREE_0 * column("f_dc_0", "f_dc_1", "f_dc_2")
    assert torch.allclose(albedo, gaussians.feature[:, :3], atol=1e-6)
    assert column("rot_0", "rot_1", "rot_2", "rot_3").norm(dim=-1).tolist() == pytest.approx([1, 1])
