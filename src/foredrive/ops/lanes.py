"""What numba kernels are made of: eight float32 channels as one value, and reading between grid cells.

LLVM's own vectoriser makes little of inner loops over a handful of channels: it cannot know their number,
nor that the arrays do not overlap. Here the kernel says it. Every function takes `Float8` or plain float32
values, so that one piece of code serves whole blocks of eight channels and the channels left over. LLVM
lowers eight lanes to whatever the processor has.

Numba's cache on disk looks at the file of the kernel only: delete it (`*.nbi`) after changes in this one.
"""

from collections.abc import Iterable
from typing import Any, no_type_check

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model

_OPTIONS = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
kernel = numba.njit(cache=True, nogil=True, **_OPTIONS)
"""Compiled at the first call, without the GIL; NaN and infinity stay what they are."""
kernel_part = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)
"""The same for what only kernels call, which compiles faster."""
inlined_part = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True, **_OPTIONS)
"""The same for what is called so often that handing over its arguments would take long."""

WIDTH = 8
"""Lanes of a `Float8`."""
_VECTOR = ir.VectorType(ir.FloatType(), WIDTH)
_CONTRACT = ("contract", "nsz")


class Float8(types.Type):
    """Numba type of eight float32 lanes."""

    def __init__(self) -> None:
        super().__init__(name="Float8")


float8 = Float8()
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)


@register_model(Float8)
class _Float8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _splat(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    first = builder.insert_element(
        ir.Constant(_VECTOR, ir.Undefined), scalar, ir.Constant(cgutils.int32_t, 0)
    )
    return _lanes(builder, first, ir.Constant(_VECTOR, ir.Undefined), [0] * WIDTH)


def _address(context: Any, builder: ir.IRBuilder, signature: Any, args: Any, value: types.Type) -> ir.Value:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    place = builder.gep(array.data, [args[1]])
    return builder.bitcast(place, _VECTOR.as_pointer()) if value is float8 else place


@intrinsic
@no_type_check
def zeros8(typing_context):
    """Eight zeros."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return ir.Constant(_VECTOR, [0.0] * WIDTH)

    return float8(), codegen


@intrinsic
@no_type_check
def load(typing_context, array, index, like):
    """Read a value of `like`'s type at flat `index` of a C-contiguous float32 array. No bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, signature, args, like), align=4)

    return like(array, types.intp, like), codegen


@intrinsic
@no_type_check
def store(typing_context, array, index, value):
    """Write `value` at flat `index` of a C-contiguous float32 array. No bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        builder.store(args[2], _address(context, builder, signature, args, value), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
@no_type_check
def mul_add(typing_context, scale, value, total):
    """Total + scale · value, with a scalar scale."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        factor = _splat(builder, args[0]) if value is float8 else args[0]
        product = builder.fmul(factor, args[1], flags=_CONTRACT)
        return builder.fadd(args[2], product, flags=_CONTRACT)

    return value(types.float32, value, value), codegen


@intrinsic
@no_type_check
def add_dots(typing_context, array, index, a, b, c, d, other):
    """Add the dot products of a, b, c and d with `other` to the four floats at flat `index` of `array`."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        four = ir.VectorType(ir.FloatType(), 4)
        products = [builder.fmul(value, args[6], flags=_CONTRACT) for value in args[2:6]]
        if other is float8:
            ab, cd = (_add_pairs(builder, *pair, 1) for pair in (products[:2], products[2:]))
            abcd = _add_pairs(builder, ab, cd, 2)
            halves = (_lanes(builder, abcd, abcd, lanes) for lanes in (range(4), range(4, 8)))
            sums = builder.fadd(*halves)
        else:
            sums = ir.Constant(four, ir.Undefined)
            for lane, product in enumerate(products):
                sums = builder.insert_element(sums, product, ir.Constant(cgutils.int32_t, lane))
        place = _address(context, builder, signature, args, types.float32)
        place = builder.bitcast(place, four.as_pointer())
        builder.store(builder.fadd(builder.load(place, align=4), sums), place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, a, a, a, a, a), codegen


def _add_pairs(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, run: int) -> ir.Value:
    """Add neighbouring runs of lanes of a and of b, the sums of a and b alternating."""
    even = [lane for lane in range(WIDTH) if lane // run % 2 == 0]
    order = [
        lane + shift
        for at in range(0, len(even), run)
        for shift in (0, WIDTH)
        for lane in even[at : at + run]
    ]
    odd = [lane + run for lane in order]
    return builder.fadd(_lanes(builder, a, b, order), _lanes(builder, a, b, odd))


def _lanes(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: Iterable[int]) -> ir.Value:
    indices = list(lanes)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(cgutils.int32_t, len(indices)), indices))


@kernel_part
@no_type_check
def neighbours(x, size):
    """The two cells beside a coordinate whose integers are cell centres: clamped indices, weights, slopes.

    Weights and slopes (their derivatives) are zero for cells outside 0 … size - 1. NaN counts as outside.
    """
    x = x if x > -2 else np.float32(-2)
    x = x if x < size else np.float32(size)
    floor = np.floor(x)
    part = x - floor
    low = np.int32(floor)
    high = low + np.int32(1)
    has_low = (low >= 0) & (low < size)
    has_high = (high >= 0) & (high < size)
    return (
        min(max(low, np.int32(0)), np.int32(size - 1)),
        min(max(high, np.int32(0)), np.int32(size - 1)),
        ONE - part if has_low else ZERO,
        part if has_high else ZERO,
        -ONE if has_low else ZERO,
        ONE if has_high else ZERO,
    )
