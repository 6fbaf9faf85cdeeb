#!/usr/bin/env bash
# onnxruntime 1.32.0 against PyTorch 2.13.0: GridSample at coordinates far outside, as points beside the camera's
# plane have them after the division by depth. "zeros" pads with 0 in PyTorch; onnxruntime reads the first pixel
# from about 1e19 on. "border" is the edge in PyTorch, 0 in onnxruntime from 3e9 on, then the first pixel.
# PyTorch itself gives NaN for a NaN in an image and 0 in a volume.
#
# Seen: the image below reads 0, 0, 2.5 at 1e9, 1e18, 1e20 with zeros (PyTorch: 0, 0, 0).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 onnx==1.23.2 onnxruntime==1.32.0 numpy
"$folder/venv/bin/python" - <<'PY'
import numpy as np
import onnx
import onnxruntime
import torch
from onnx import TensorProto, helper

PLACES = np.array([0, 2, 1e6, 1e9, 1e18, 1e20, np.nan], "f4")
image = np.arange(1, 13, dtype="f4").reshape(1, 1, 3, 4)
volume = np.arange(1, 25, dtype="f4").reshape(1, 1, 2, 3, 4)


def both(values, padding):
    """Return what each reads at the places along the width, in the middle of the other axes."""
    axes = values.ndim - 2
    grid = np.stack([PLACES] + [np.zeros_like(PLACES)] * (axes - 1), -1).reshape(1, *[1] * (axes - 1), -1, axes)
    node = helper.make_node(
        "GridSample", ["x", "g"], ["y"], mode="linear", padding_mode=padding, align_corners=0
    )
    tensor = helper.make_tensor_value_info
    inputs = [tensor("x", TensorProto.FLOAT, values.shape), tensor("g", TensorProto.FLOAT, grid.shape)]
    graph = helper.make_graph([node], "g", inputs, [tensor("y", TensorProto.FLOAT, None)])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    read = session.run(None, {"x": values, "g": grid})[0].ravel()
    known = torch.nn.functional.grid_sample(
        torch.tensor(values), torch.tensor(grid), padding_mode=padding, align_corners=False
    )
    return read, known.numpy().ravel()


print(onnxruntime.__version__, torch.__version__, "at", PLACES)
for name, values in (("image", image), ("volume", volume)):
    for padding in ("zeros", "border"):
        read, known = both(values, padding)
        print(name, padding, "onnxruntime", read, "torch", known)
        near, far = slice(0, 3), 5
        assert np.array_equal(read[near], known[near])
        assert read[far] != known[far] and read[far] not in (0.0, known[1])
        assert np.isnan(known[-1]) == (name == "image" and padding == "zeros")
PY
