"""Gaussians as the PLY files that viewers of 3-D Gaussians read (Kerbl et al., 2023)."""

from pathlib import Path

import numpy as np
import torch

from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.rendering.gaussians import Gaussians

_SH_DEGREE_0 = 0.28209479177387814
"""Albedo is 0.5 plus this times the constant coefficient."""
_MEAN = ("x", "y", "z")
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_WRITTEN = (*_MEAN, "nx", "ny", "nz", *_COLOUR, "opacity", *_SCALE, *_ROTATION)
_NUMBERS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write centres, rotations, scales, opacities and albedo; what decoders add to it has no place there."""
    gaussians = gaussians.map_tensors(lambda tensor: tensor.detach().cpu())
    columns = [
        gaussians.mean_m,
        torch.zeros_like(gaussians.mean_m),
        (gaussians.feature[:, :3] - 0.5) / _SH_DEGREE_0,
        gaussians.opacity_logit[:, None],
        gaussians.log_scale,
        torch.nn.functional.normalize(gaussians.quaternion, dim=-1),
    ]
    table = torch.cat(columns, dim=-1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [*(f"property float {name}" for name in _WRITTEN), "end_header"]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(table.tobytes())


def read_ply(path: Path, features: int = 0) -> Gaussians:
    """Read Gaussians; of spherical harmonics the constant part, as albedo.

    Args:
        path: a binary, little-endian file.
        features: how many features to give them beside albedo, all 0.

    Raises:
        InputError: on a file that cannot be read, or is no PLY of Gaussians.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    head, found, body = content.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not found or lines[0].strip() != "ply" or "format binary_little_endian 1.0" not in lines:
        raise InputError(f"{path}: not a binary, little-endian PLY file")
    count, fields = _vertices(path, lines)
    kind = np.dtype(fields)
    if len(body) < count * kind.itemsize:
        raise InputError(f"{path}: ends before the last of its {count} Gaussians")
    table = np.frombuffer(body, kind, count)
    there = {name for name, _ in fields}
    missing = [n for n in (*_MEAN, *_COLOUR, "opacity", *_SCALE, *_ROTATION) if n not in there]
    if missing:
        raise InputError(f"{path}: not a PLY file of Gaussians: {missing[0]} is missing")

    def column(*names: str) -> torch.Tensor:
        return torch.from_numpy(np.stack([table[name] for name in names], -1).astype(np.float32))

    albedo = 0.5 + _SH_DEGREE_0 * column(*_COLOUR)
    return Gaussians(
        mean_m=column(*_MEAN),
        quaternion=column(*_ROTATION),
        log_scale=column(*_SCALE),
        opacity_logit=column("opacity")[:, 0],
        feature=torch.nn.functional.pad(albedo, (0, features)),
    )


def _vertices(path: Path, lines: list[str]) -> tuple[int, list[tuple[str, str]]]:
    """How many vertices there are, and their fields; they come first."""
    count, fields = None, []
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            if count is not None:
                break
            if len(words) != 3 or words[1] != "vertex" or not words[2].isdecimal():
                raise InputError(f"{path}: the first element of the file is not its vertices")
            count = int(words[2])
        elif words[:1] == ["property"] and count is not None:
            if len(words) != 3 or words[1] not in _NUMBERS:
                raise InputError(f"{path}: a property that is no number: {' '.join(words[1:])}")
            fields.append((words[2], "<" + _NUMBERS[words[1]]))
    if count is None:
        raise InputError(f"{path}: no vertices")
    return count, fields
