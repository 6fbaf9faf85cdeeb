"""Gaussians to files and back."""

from pathlib import Path

import numpy as np
import pytest
import torch
from test_scene_graph import graph_of, two_actors

from foredrive.errors import InputError
from foredrive.rendering.ply import read_ply, write_ply
from foredrive.rendering.scene_graph import STATIC


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    gaussians = graph_of([[1.0, 2, 3], [4.0, 5, 6]], [STATIC, STATIC], two_actors()).gaussians
    write_ply(gaussians, tmp_path / "scene.ply")
    again = read_ply(tmp_path / "scene.ply", features=2)
    assert torch.equal(again.mean_m, gaussians.mean_m)
    assert torch.equal(again.log_scale, gaussians.log_scale)
    assert torch.allclose(again.feature, torch.nn.functional.pad(gaussians.feature, (0, 2)), atol=1e-6)


def test_a_file_of_somebody_elses(tmp_path: Path) -> None:
    """Other columns between, other numbers, more harmonics; colour is that of the constant one."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    row = np.array([(1, 2, 3, 1, 0, -1, 9, 0.5, -1, -2, -3, 1, 0, 0, 0)], dtype=[(n, "<f8") for n in names])
    header = "ply\nformat binary_little_endian 1.0\ncomment made elsewhere\nelement vertex 1\n"
    header += "".join(f"property double {n}\n" for n in names) + "end_header\n"
    (tmp_path / "other.ply").write_bytes(header.encode() + row.tobytes())
    gaussians = read_ply(tmp_path / "other.ply")
    assert gaussians.mean_m.tolist() == [[1, 2, 3]]
    assert gaussians.feature[0].tolist() == pytest.approx([0.782095, 0.5, 0.217905])
    assert gaussians.log_scale.tolist() == [[-1, -2, -3]]


PLY = b"ply\nformat binary_little_endian 1.0\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"solid cube", "not a binary, little-endian PLY"),
        (b"ply\nformat ascii 1.0\nend_header\n", "not a binary, little-endian PLY"),
        (
            PLY + b"element vertex 2\nproperty float x\nend_header\n0123",
            "ends before",
        ),
        (
            PLY + b"element vertex 1\nproperty float x\nend_header\n0123",
            "y is missing",
        ),
        (PLY + b"element face 1\nend_header\n", "first element"),
    ],
)
def test_what_is_no_file_of_gaussians_is_told(tmp_path: Path, content: bytes, told: str) -> None:
    file = tmp_path / "bad.ply"
    file.write_bytes(content)
    with pytest.raises(InputError, match=told):
        read_ply(file)
