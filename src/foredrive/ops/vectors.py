"""Vectors of eight or sixteen float32 numbers as one value in numba kernels, and interpolation helpers.

LLVM's own vectoriser does not handle short inner loops well: it does not know the number of elements, nor
that the arrays do not overlap. Here the kernels use vectors explicitly. LLVM lowers a vector to the registers
of the processor: sixteen lanes are one register with AVX-512, two with AVX, four with NEON.

Kernels that read channels use blocks of eight (`zeros8`), then the remaining channels one by one, with the
same code: `load`, `store` and `mul_add` also accept a plain float32. Kernels of splats and attention use rows
of sixteen (`ROW`) with operators.

Numba's disk cache checks only the file of the kernel. Delete the cache (`*.nbi`) after changes in this file.
"""

import operator
from collections.abc import Callable, Iterable
from typing import Any, no_type_check

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

_OPTIONS = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
kernel = numba.njit(cache=True, nogil=True, **_OPTIONS)
"""Decorator of kernels: compiled at the first call, without the GIL. NaN and infinity are preserved."""
kernel_part = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)
"""Decorator of functions that only kernels call. They compile faster."""
inlined_part = numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, forceinline=True, **_OPTIONS)
"""Decorator of small functions that are called very often. They are inlined, because passing arguments is
slow."""

WIDTH, ROW = 8, 16
"""Lanes of the two vector types."""
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
_CONTRACT, _REORDER = ("contract", "nsz"), ("contract", "nsz", "reassoc")


class Vector(types.Type):
    """The numba type of a vector with a number of float32 lanes."""

    def __init__(self, lanes: int) -> None:
        super().__init__(name=f"Float32x{lanes}")
        self.form = ir.VectorType(ir.FloatType(), lanes)


float8, a_row = Vector(WIDTH), Vector(ROW)
_FORM, _WHOLE = a_row.form, ir.VectorType(cgutils.int32_t, ROW)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Vector) -> None:
        super().__init__(manager, numba_type, numba_type.form)


def _shuffled(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: Iterable[int]) -> ir.Value:
    """Return the chosen lanes of a and b. Lanes of b are numbered after those of a."""
    indices = list(lanes)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(cgutils.int32_t, len(indices)), indices))


def _broadcast(builder: ir.IRBuilder, scalar: ir.Value, form: ir.VectorType = _FORM) -> ir.Value:
    undefined = ir.Constant(form, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(cgutils.int32_t, 0))
    return _shuffled(builder, first, undefined, [0] * form.count)


def _address(context: Any, builder: ir.IRBuilder, signature: Any, args: Any, form: ir.Type) -> ir.Value:
    """Return the address of a value of type `form` at flat index args[1] of array args[0]."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.bitcast(builder.gep(array.data, [args[1]]), form.as_pointer())


def _add_runs(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, run: int) -> ir.Value:
    """Add adjacent runs of lanes within a and within b. The sums of a and of b alternate in the result."""
    count = a.type.count
    even = [lane for lane in range(count) if lane // run % 2 == 0]
    order = [
        lane + shift
        for at in range(0, len(even), run)
        for shift in (0, count)
        for lane in even[at : at + run]
    ]
    odd = [lane + run for lane in order]
    return builder.fadd(_shuffled(builder, a, b, order), _shuffled(builder, a, b, odd))


@intrinsic
@no_type_check
def load(typing_context, array, index, like):
    """Read a value of `like`'s type at `index` of a C-contiguous float32 array, without bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, signature, args, args[2].type), align=4)

    return like(array, types.intp, like), codegen


@intrinsic
@no_type_check
def load_row(typing_context, array, index):
    """Read sixteen numbers at flat `index` of a C-contiguous float32 array, without a bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.load(_address(context, builder, signature, args, _FORM), align=4)

    return a_row(array, types.intp), codegen


@intrinsic
@no_type_check
def store(typing_context, array, index, value):
    """Write `value` at flat `index` of a C-contiguous float32 array, without bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        builder.store(args[2], _address(context, builder, signature, args, args[2].type), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
@no_type_check
def zeros8(typing_context):
    """Return eight zeros."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return ir.Constant(float8.form, [0.0] * WIDTH)

    return float8(), codegen


@intrinsic
@no_type_check
def mul_add(typing_context, scale, value, total):
    """Return total + scale · value, with a scalar scale."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        factor = _broadcast(builder, args[0], value.form) if isinstance(value, Vector) else args[0]
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
            ab, cd = (_add_runs(builder, *pair, 1) for pair in (products[:2], products[2:]))
            abcd = _add_runs(builder, ab, cd, 2)
            halves = (_shuffled(builder, abcd, abcd, lanes) for lanes in (range(4), range(4, 8)))
            sums = builder.fadd(*halves)
        else:
            sums = ir.Constant(four, ir.Undefined)
            for lane, product in enumerate(products):
                sums = builder.insert_element(sums, product, ir.Constant(cgutils.int32_t, lane))
        place = _address(context, builder, signature, args, four)
        builder.store(builder.fadd(builder.load(place, align=4), sums), place, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, a, a, a, a, a), codegen


@kernel_part
@no_type_check
def neighbours(x, size):
    """Return the two cells beside a coordinate: clamped indices, weights, slopes. Integers are cell centres.

    Slopes are the derivatives of the weights. Weights and slopes are zero for cells outside 0 … size - 1. NaN
    counts as outside.
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


def _as_rows(builder: ir.IRBuilder, args: Any) -> list[ir.Value]:
    """Return the arguments as rows. Scalars are broadcast."""
    return [value if value.type == _FORM else _broadcast(builder, value) for value in args]


def _kinds(*given: types.Type) -> list[types.Type]:
    """Return the numba types of arguments that are each a row or a float32."""
    return [kind if kind is a_row else types.float32 for kind in given]


def _elementwise(emit: Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]) -> Any:
    """Return an intrinsic of two rows, one of which may be a float32."""

    @intrinsic
    @no_type_check
    def apply(typing_context, a, b):
        if a_row not in (a, b):
            return None

        def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
            return emit(builder, _as_rows(builder, args))

        return a_row(*_kinds(a, b)), codegen

    return apply


def _select(order: str) -> Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]:
    def emit(builder: ir.IRBuilder, args: list[ir.Value]) -> ir.Value:
        return builder.select(builder.fcmp_ordered(order, *args), *args)

    return emit


least = _elementwise(_select("<"))
"""Elementwise minimum. It returns the second argument where one is NaN."""
greatest = _elementwise(_select(">"))
"""Elementwise maximum. It returns the second argument where one is NaN."""


def _operator(symbol: Any, emit: Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]) -> None:
    apply = _elementwise(emit)

    @overload(symbol)
    @no_type_check
    def implement(a, b):
        if a_row in (a, b) and all(kind is a_row or isinstance(kind, types.Float) for kind in (a, b)):
            return lambda a, b: apply(a, b)
        return None


_operator(operator.add, lambda builder, args: builder.fadd(*args, flags=_REORDER))
_operator(operator.sub, lambda builder, args: builder.fsub(*args, flags=_REORDER))
_operator(operator.mul, lambda builder, args: builder.fmul(*args, flags=_REORDER))
_operator(operator.truediv, lambda builder, args: builder.fdiv(*args, flags=_REORDER))


@intrinsic
@no_type_check
def row_of(typing_context, scalar):
    """Return a row with sixteen copies of a scalar."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return _broadcast(builder, args[0])

    return a_row(types.float32), codegen


@intrinsic
@no_type_check
def where_more(typing_context, a, b, yes, no):
    """Return `yes` where a > b, else `no`, elementwise. Each argument is a row or a float32."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        a, b, yes, no = _as_rows(builder, args)
        return builder.select(builder.fcmp_ordered(">", a, b), yes, no)

    return a_row(*_kinds(a, b, yes, no)), codegen


@intrinsic
@no_type_check
def bits_more(typing_context, a, b):
    """Return an integer with bit k set where a > b in lane k."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        above = builder.fcmp_ordered(">", *_as_rows(builder, args))
        return builder.zext(builder.bitcast(above, ir.IntType(ROW)), cgutils.int32_t)

    return types.uint32(*_kinds(a, b)), codegen


@intrinsic
@no_type_check
def lowest_bit(typing_context, bits):
    """Return the position of the lowest set bit of a non-zero integer."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.zext(builder.cttz(args[0], ir.Constant(ir.IntType(1), 1)), cgutils.intp_t)

    return types.intp(types.uint32), codegen


def _halving(pair: Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]) -> Any:
    """Return an intrinsic that reduces a row to one float32 by halving it repeatedly."""

    @intrinsic
    @no_type_check
    def apply(typing_context, row):
        def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
            (value,) = args
            for half in (8, 4, 2, 1):
                other = [(lane + half) % ROW for lane in range(ROW)]
                value = pair(builder, value, _shuffled(builder, value, value, other))
            return builder.extract_element(value, ir.Constant(cgutils.int32_t, 0))

        return types.float32(a_row), codegen

    return apply


total_of = _halving(lambda builder, a, b: builder.fadd(a, b, flags=_REORDER))
"""Sum of the numbers of a row."""
greatest_in = _halving(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
"""Largest number of a row."""


@intrinsic
@no_type_check
def totals(typing_context, array, index):
    """Return the sums of sixteen consecutive rows from flat `index` of an array, as one row."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        first = _address(context, builder, signature, args, _FORM)
        places = [builder.gep(first, [ir.Constant(cgutils.int32_t, k)]) for k in range(ROW)]
        rows = [builder.load(place, align=4) for place in places]
        while len(rows) > 1:  # halve the rows, and the lanes of each row
            run = ROW // len(rows)
            rows = [_add_runs(builder, a, b, run) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    return a_row(array, types.intp), codegen


@intrinsic
@no_type_check
def prefetch(typing_context, array, index):
    """Prefetch the cache line at flat `index` of an array."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        place = _address(context, builder, signature, args, ir.IntType(8))
        flags = [ir.Constant(cgutils.int32_t, k) for k in (0, 3, 1)]  # read, high locality, data
        kind = ir.FunctionType(ir.VoidType(), [place.type, *(flag.type for flag in flags)])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [place, *flags])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
@no_type_check
def _floor(typing_context, row):
    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        kind = ir.FunctionType(_FORM, [_FORM])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.floor.v{ROW}f32")
        return builder.call(function, args)

    return a_row(a_row), codegen


@intrinsic
@no_type_check
def _power_of_2(typing_context, row):
    """Return 2^n of integers n from -126 to 127, written directly into the exponent bits."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        whole = builder.add(builder.fptosi(args[0], _WHOLE), ir.Constant(_WHOLE, [127] * ROW))
        return builder.bitcast(builder.shl(whole, ir.Constant(_WHOLE, [23] * ROW)), _FORM)

    return a_row(a_row), codegen


_C5, _C4, _C3, _C2, _C1 = (
    np.float32(c) for c in (1.86713e-3, 9.01703e-3, 5.579991e-2, 2.4016445e-1, 6.9315131e-1)
)
"""Coefficients of 2^f ≈ 1 + f (C1 + f (C2 + …)) for f from 0 to 1, with relative error below 8e-8. They are
the minimax polynomial of degree 5, found by reweighted least squares."""
_LEAST = np.float32(-126)


@inlined_part
@no_type_check
def exp2_row(x):
    """Return 2^x for x ≤ 127, with relative error below 3e-7. For x < -126 return 2^-126."""
    x = greatest(x, _LEAST)
    whole = _floor(x)
    f = x - whole
    polynomial = ((((f * _C5 + _C4) * f + _C3) * f + _C2) * f + _C1) * f + ONE
    return polynomial * _power_of_2(whole)
