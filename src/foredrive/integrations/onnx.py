"""Conversion of an exported program to ONNX, with the operators that PyTorch's exporter cannot translate.

Needs the extra `export` (onnx, onnxscript, onnxruntime).
"""

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from onnxscript import opset20 as op
from torch.export import ExportedProgram

OPSET = 20
"""The first opset whose GridSample reads volumes."""
NOISY_LOGGER = "torch.onnx._internal.exporter._registration"
"""Logger that reports torchvision's operators as missing if it is not installed."""


def write_onnx(
    program: ExportedProgram, path: Path, input_names: Sequence[str], output_names: Sequence[str]
) -> None:
    """Write a program as an ONNX model of opset 20."""
    logger = logging.getLogger(NOISY_LOGGER)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # Raised by the exporter itself
            model = torch.onnx.export(
                program,
                dynamo=True,
                opset_version=OPSET,
                input_names=list(input_names),
                output_names=list(output_names),
                custom_translation_table=TRANSLATIONS,
                optimize=False,  # It takes minutes, and onnxruntime optimises again
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    assert model is not None
    model.save(path)


def _grid_sampler_3d(
    input: Any, grid: Any, interpolation_mode: int, padding_mode: int, align_corners: bool
) -> Any:
    if (interpolation_mode, padding_mode, align_corners) != (0, 0, False):
        raise NotImplementedError("volumes are read trilinearly, with zeros outside and unaligned corners")
    return op.GridSample(input, grid, mode="linear", padding_mode="zeros", align_corners=0)


def _adaptive_avg_pool3d(self: Any, output_size: Sequence[int]) -> Any:
    """Average over windows ⌊i·n/m⌋ to ⌈(i+1)·n/m⌉, one axis after the other."""
    sizes = [int(size) for size in self.shape]
    for axis, windows in enumerate(output_size, start=len(sizes) - 3):
        # -(-a // b) rounds up
        bounds = [(i * sizes[axis] // windows, -(-(i + 1) * sizes[axis] // windows)) for i in range(windows)]
        means = [op.ReduceMean(_slice(self, axis, *bound), _ints(axis), keepdims=1) for bound in bounds]
        self = op.Concat(*means, axis=axis)
    return self


def _cummax(self: Any, dim: int) -> tuple[Any, Any]:
    """Return values and their indices, with the last index of equal values, as in PyTorch."""
    steps = [_slice(self, dim, k, k + 1) for k in range(int(self.shape[dim]))]
    # Zeros of the right shape and integer type, the index of the first step
    values, places = [steps[0]], [op.CastLike(op.Sub(steps[0], steps[0]), _ints(0))]
    for k, step in enumerate(steps[1:], start=1):
        rises = op.GreaterOrEqual(step, values[-1])
        values.append(op.Where(rises, step, values[-1]))
        places.append(op.Where(rises, _ints(k), places[-1]))
    return op.Concat(*values, axis=dim), op.Concat(*places, axis=dim)


def _attention(
    query: Any,
    key: Any,
    value: Any,
    attn_mask: Any = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
    scale: float | None = None,
    enable_gqa: bool = False,
) -> Any:
    """Return softmax(Q Kᵀ / √d + mask) V with any number of leading dimensions; PyTorch exports only two.

    The mask is added: 0 where attention is allowed, -∞ elsewhere, as `nn.MultiheadAttention` gives it.
    """
    if dropout_p or is_causal or scale is not None or enable_gqa:
        raise NotImplementedError("attention with dropout, another scale or shared heads")
    rank = len(query.shape)
    turned = op.Transpose(key, perm=[*range(rank - 2), rank - 1, rank - 2])
    # Scaling the query instead of the scores needs fewer products
    scaled = op.Mul(query, op.Constant(value_float=int(query.shape[-1]) ** -0.5))
    score = op.MatMul(scaled, turned)
    if attn_mask is None:
        return op.MatMul(op.Softmax(score, axis=-1), value)
    score = op.Add(score, attn_mask)
    # A row without keys is 0 in PyTorch; the softmax of -∞ alone would be NaN
    has_key = op.Greater(op.ReduceMax(score, _ints(-1), keepdims=1), op.Constant(value_float=float("-inf")))
    weights = op.Softmax(op.Where(has_key, score, op.CastLike(_ints(0), score)), axis=-1)
    return op.MatMul(op.Mul(weights, op.CastLike(has_key, score)), value)


def _slice(tensor: Any, axis: int, start: int, stop: int) -> Any:
    return op.Slice(tensor, _ints(start), _ints(stop), _ints(axis))


def _ints(*values: int) -> Any:
    return op.Constant(value_ints=list(values))


TRANSLATIONS: dict[Callable[..., Any], Callable[..., Any]] = {
    torch.ops.aten.grid_sampler_3d.default: _grid_sampler_3d,
    torch.ops.aten.adaptive_avg_pool3d.default: _adaptive_avg_pool3d,
    torch.ops.aten.cummax.default: _cummax,
    torch.ops.aten.scaled_dot_product_attention.default: _attention,
}
