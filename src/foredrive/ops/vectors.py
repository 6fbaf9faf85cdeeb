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


float32x8, float32x16 = Vector(WIDTH), Vector(ROW)
_ROW_TYPE, _INT_ROW_TYPE = float32x16.form, ir.VectorType(cgutils.int32_t, ROW)
Emit = Callable[..., ir.Value]
"""A function that appends instructions to an IR builder. It returns their result."""


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Vector) -> None:
        super().__init__(manager, numba_type, numba_type.form)


def _shuffle(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, lanes: Iterable[int]) -> ir.Value:
    """Return the chosen lanes of a and b. Lanes of b are numbered after those of a."""
    indices = list(lanes)
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(cgutils.int32_t, len(indices)), indices))


def _broadcast(builder: ir.IRBuilder, scalar: ir.Value, form: ir.VectorType = _ROW_TYPE) -> ir.Value:
    # LLVM has no broadcast: put the number in lane 0, then shuffle lane 0 to all lanes
    undefined = ir.Constant(form, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(cgutils.int32_t, 0))
    return _shuffle(builder, first, undefined, [0] * form.count)


def _address(context: Any, builder: ir.IRBuilder, signature: Any, args: Any, form: ir.Type) -> ir.Value:
    """Return the address of a value of type `form` at flat index args[1] of array args[0]."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.bitcast(builder.gep(array.data, [args[1]]), form.as_pointer())


def _add_adjacent(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, run: int) -> ir.Value:
    """Add adjacent runs of lanes within a and within b. The sums of a and of b alternate in the result."""
    count = a.type.count
    # Lanes of the even runs of a and b, alternately; the odd runs follow each by `run` lanes
    even = [lane for lane in range(count) if lane // run % 2 == 0]
    order = [
        lane + shift
        for place in range(0, len(even), run)
        for shift in (0, count)
        for lane in even[place : place + run]
    ]
    odd = [lane + run for lane in order]
    return builder.fadd(_shuffle(builder, a, b, order), _shuffle(builder, a, b, odd))


@intrinsic
@no_type_check
def load(typing_context, array, index, like):
    """Read a value of `like`'s type at `index` of a C-contiguous float32 array, without bounds check."""
    return like(array, types.intp, like), lambda context, builder, signature, args: builder.load(
        _address(context, builder, signature, args, args[2].type), align=4
    )


@intrinsic
@no_type_check
def load_row(typing_context, array, index):
    """Read sixteen numbers at flat `index` of a C-contiguous float32 array, without a bounds check."""
    return float32x16(array, types.intp), lambda context, builder, signature, args: builder.load(
        _address(context, builder, signature, args, _ROW_TYPE), align=4
    )


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
    return float32x8(), lambda *_: ir.Constant(float32x8.form, [0.0] * WIDTH)


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
        # Products of all lanes first, then a tree of additions over adjacent lanes
        products = [builder.fmul(value, args[6], flags=_CONTRACT) for value in args[2:6]]
        if other is float32x8:
            ab, cd = (_add_adjacent(builder, *pair, 1) for pair in (products[:2], products[2:]))
            abcd = _add_adjacent(builder, ab, cd, 2)
            # Lanes 0-3 and 4-7 hold partial sums of a, b, c, d in the same order
            halves = (_shuffle(builder, abcd, abcd, lanes) for lanes in (range(4), range(4, 8)))
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
    # One cell outside all weights are zero: the clamp keeps the conversion to int32 defined, also for NaN
    x = x if x > -2 else np.float32(-2)
    x = x if x < size else np.float32(size)
    floor = np.floor(x)
    part = x - floor
    low = np.int32(floor)
    high = low + np.int32(1)
    has_low = (low >= 0) & (low < size)
    has_high = (high >= 0) & (high < size)
    # Clamped indices stay in memory; where they are clamped the weight is zero
    return (
        min(max(low, np.int32(0)), np.int32(size - 1)),
        min(max(high, np.int32(0)), np.int32(size - 1)),
        ONE - part if has_low else ZERO,
        part if has_high else ZERO,
        -ONE if has_low else ZERO,
        ONE if has_high else ZERO,
    )


def _unary(emit: Emit, argument_type: types.Type = float32x16, result: types.Type = float32x16) -> Any:
    """Return an intrinsic of one argument."""

    @intrinsic
    @no_type_check
    def apply(typing_context, value):
        return result(argument_type), lambda context, builder, signature, args: emit(builder, *args)

    return apply


def _elementwise(emit: Emit, result: types.Type = float32x16) -> Any:
    """Return an intrinsic of two rows, one of which may be a float32."""

    @intrinsic
    @no_type_check
    def apply(typing_context, a, b):
        if float32x16 not in (a, b):
            return None
        return result(*_row_types(a, b)), lambda context, builder, signature, args: emit(
            builder, *_as_rows(builder, args)
        )

    return apply


def _as_rows(builder: ir.IRBuilder, args: Any) -> list[ir.Value]:
    """Return the arguments as rows. Scalars are broadcast."""
    return [value if value.type == _ROW_TYPE else _broadcast(builder, value) for value in args]


def _row_types(*given: types.Type) -> list[types.Type]:
    """Return the numba types of arguments that are each a row or a float32."""
    return [kind if kind is float32x16 else types.float32 for kind in given]


def _operator(symbol: Any, emit: Emit) -> None:
    apply = _elementwise(emit)

    @overload(symbol)
    @no_type_check
    def implement(a, b):
        if float32x16 in (a, b) and all(
            kind is float32x16 or isinstance(kind, types.Float) for kind in (a, b)
        ):
            return lambda a, b: apply(a, b)
        return None


_operator(operator.add, lambda builder, a, b: builder.fadd(a, b, flags=_REORDER))
_operator(operator.sub, lambda builder, a, b: builder.fsub(a, b, flags=_REORDER))
_operator(operator.mul, lambda builder, a, b: builder.fmul(a, b, flags=_REORDER))
_operator(operator.truediv, lambda builder, a, b: builder.fdiv(a, b, flags=_REORDER))


def _select(order: str) -> Emit:
    return lambda builder, a, b: builder.select(builder.fcmp_ordered(order, a, b), a, b)


minimum = _elementwise(_select("<"))
"""Elementwise minimum. It returns the second argument where one is NaN."""
maximum = _elementwise(_select(">"))
"""Elementwise maximum. It returns the second argument where one is NaN."""
broadcast = _unary(_broadcast, argument_type=types.float32)
"""Row with sixteen copies of a float32."""


def _mask(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.zext(builder.bitcast(builder.fcmp_ordered(">", a, b), ir.IntType(ROW)), cgutils.int32_t)


greater_mask = _elementwise(_mask, result=types.uint32)
"""Integer with bit k set where a > b in lane k."""
lowest_set_bit = _unary(
    lambda builder, bits: builder.zext(builder.cttz(bits, ir.Constant(ir.IntType(1), 1)), cgutils.intp_t),
    argument_type=types.uint32,
    result=types.intp,
)
"""Position of the lowest set bit of a non-zero integer."""


@intrinsic
@no_type_check
def select_greater(typing_context, a, b, yes, no):
    """Return `yes` where a > b, else `no`, elementwise. Each argument is a row or a float32."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        a, b, yes, no = _as_rows(builder, args)
        return builder.select(builder.fcmp_ordered(">", a, b), yes, no)

    return float32x16(*_row_types(a, b, yes, no)), codegen


def _reduction(combine: Emit) -> Any:
    """Return an intrinsic that reduces a row to one float32 by halving it repeatedly."""

    def emit(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
        # Rotate by half, a quarter, …: after four steps every lane has the result
        for half in (8, 4, 2, 1):
            other = [(lane + half) % ROW for lane in range(ROW)]
            value = combine(builder, value, _shuffle(builder, value, value, other))
        return builder.extract_element(value, ir.Constant(cgutils.int32_t, 0))

    return _unary(emit, result=types.float32)


row_sum = _reduction(lambda builder, a, b: builder.fadd(a, b, flags=_REORDER))
"""Sum of the numbers of a row."""
row_max = _reduction(_select(">"))
"""Largest number of a row."""


@intrinsic
@no_type_check
def row_sums(typing_context, array, index):
    """Return the sums of sixteen consecutive rows from flat `index` of an array, as one row."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        first = _address(context, builder, signature, args, _ROW_TYPE)
        places = [builder.gep(first, [ir.Constant(cgutils.int32_t, k)]) for k in range(ROW)]
        rows = [builder.load(place, align=4) for place in places]
        while len(rows) > 1:  # halve the rows, and the lanes of each row
            # After k steps each of 16 / 2^k rows holds partial sums of 2^k original rows
            run = ROW // len(rows)
            rows = [_add_adjacent(builder, a, b, run) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    return float32x16(array, types.intp), codegen


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


def _built_in(name: str) -> Emit:
    """Return the emission of a function of LLVM for rows."""
    kind = ir.FunctionType(_ROW_TYPE, [_ROW_TYPE])
    return lambda builder, row: builder.call(
        cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{ROW}f32"), [row]
    )


def _emit_power_of_2(builder: ir.IRBuilder, row: ir.Value) -> ir.Value:
    """Return 2^n of integers n from -126 to 127, written directly into the exponent bits."""
    # Biased exponent of a float32 in bits 23 to 30
    exponent = builder.add(builder.fptosi(row, _INT_ROW_TYPE), ir.Constant(_INT_ROW_TYPE, [127] * ROW))
    return builder.bitcast(builder.shl(exponent, ir.Constant(_INT_ROW_TYPE, [23] * ROW)), _ROW_TYPE)


floor_row, sqrt_row = _unary(_built_in("floor")), _unary(_built_in("sqrt"))
_power_of_2 = _unary(_emit_power_of_2)
_C5, _C4, _C3, _C2, _C1 = (
    np.float32(c) for c in (1.86713e-3, 9.01703e-3, 5.579991e-2, 2.4016445e-1, 6.9315131e-1)
)
"""Coefficients of 2^f ≈ 1 + f (C1 + f (C2 + …)) for f from 0 to 1, with relative error below 8e-8. They are
the minimax polynomial of degree 5, found by reweighted least squares."""
_MIN_EXPONENT = np.float32(-126)


@inlined_part
@no_type_check
def exp2_row(x):
    """Return 2^x for x ≤ 127, with relative error below 3e-7. For x < -126 return 2^-126."""
    x = maximum(x, _MIN_EXPONENT)
    # 2^x = 2^⌊x⌋ · 2^f
    whole = floor_row(x)
    f = x - whole
    polynomial = ((((f * _C5 + _C4) * f + _C3) * f + _C2) * f + _C1) * f + ONE
    return polynomial * _power_of_2(whole)


_A15, _A13, _A11, _A9, _A7, _A5, _A3, _A1 = (
    np.float32(c)
    for c in (
        *(-0.0040540580, 0.0218612288, -0.0559098861, 0.0964200441),
        *(-0.1390853351, 0.1994653599, -0.3332985605, 0.9999993329),
    )
)
"""Coefficients of atan(a) ≈ a (A1 + A3 a² + …) for a from 0 to 1, with an error below 4e-8 (Abramowitz and
Stegun, "Handbook of Mathematical Functions", 1964, 4.4.49)."""
_QUARTER_TURN, _HALF_TURN = np.float32(np.pi / 2), np.float32(np.pi)
_TINY = np.float32(1e-30)


@inlined_part
@no_type_check
def atan2_row(y, x):
    """Return the angle of (x, y), rad, with an error below 3e-7. At (0, 0) it is 0."""
    across, along = maximum(y, ZERO - y), maximum(x, ZERO - x)
    # The smaller over the larger one lies between 0 and 1
    a = minimum(across, along) / maximum(maximum(across, along), _TINY)
    a2 = a * a
    even = ((((((a2 * _A15 + _A13) * a2 + _A11) * a2 + _A9) * a2 + _A7) * a2 + _A5) * a2 + _A3) * a2 + _A1
    angle = even * a
    # Octant by octant: above the diagonal, to the left, below
    angle = select_greater(across, along, _QUARTER_TURN - angle, angle)
    angle = select_greater(ZERO, x, _HALF_TURN - angle, angle)
    return select_greater(ZERO, y, ZERO - angle, angle)
