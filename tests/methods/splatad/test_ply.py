"""Gaussians as files that viewers read."""

from pathlib import Path

import numpy as np
import torch
from methods.reconstruction.test_scene_graph import graph_of, two_actors
from plyfile import PlyData

from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.splatad.ply import SH_DEGREE_0, write_ply

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{number}" for number in range(45)),  # 15 of each colour: degree 3
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def test_a_file_holds_what_viewers_look_for(tmp_path: Path) -> None:
    gaussians = graph_of([[1.0, 2, 3], [4.0, 5, 6]], [STATIC, STATIC], two_actors()).content.preview(STATIC)
    write_ply(gaussians, tmp_path / "scene.ply")
    content = (tmp_path / "scene.ply").read_bytes()
    header, data = content.split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    comments = [line for line in lines if line.startswith("comment ")]
    assert "antialiased" in comments[0]
    assert any("z is up" in line for line in comments)
    assert comments[-1] == "comment left out: 0 splats far beyond the others"
    assert lines[2] == "element vertex 2"  # SIBR's viewer takes the number from there
    assert [line for line in lines if line not in comments] == [
        *("ply", "format binary_little_endian 1.0", "element vertex 2"),
        *(f"property float {name}" for name in NAMES),
    ]
    assert len(data) == 2 * 4 * len(NAMES)

    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"]

    def column(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1))

    assert torch.equal(column("x", "y", "z"), gaussians.mean_m)
    assert torch.equal(column("scale_0", "scale_1", "scale_2"), gaussians.log_scale)
    assert torch.equal(column("opacity")[:, 0], gaussians.opacity_logit)
    assert not column(*(f"f_rest_{number}" for number in range(45))).any()
    albedo = 0.5 + SH_DEGREE_0 * column("f_dc_0", "f_dc_1", "f_dc_2")
    assert torch.allclose(albedo, gaussians.feature[:, :3], atol=1e-6)
    rotations = torch.nn.functional.normalize(gaussians.quaternion, dim=-1)
    assert torch.allclose(column("rot_0", "rot_1", "rot_2", "rot_3"), rotations)


def test_splats_far_beyond_the_scene_are_left_out(tmp_path: Path) -> None:
    """Twenty along a street of 190 m, and one 18 km away, to which a viewer would fit its camera."""
    means = [*([10.0 * n, 0.0, 1.0] for n in range(20)), [18_000.0, 0.0, 300.0]]
    gaussians = graph_of(means, [STATIC] * len(means), two_actors()).content.preview(STATIC)
    write_ply(gaussians, tmp_path / "scene.ply")
    vertices = PlyData.read(tmp_path / "scene.ply")["vertex"]
    assert vertices["x"].tolist() == [10.0 * n for n in range(20)]
    assert b"comment left out: 1 splats far beyond the others" in (tmp_path / "scene.ply").read_bytes()
