"""Sixteen float32 numbers as one value in numba kernels, with the arithmetic that goes with it.

LLVM lowers a row to whatever the processor has: one register with AVX-512, two with AVX, four with NEON.

Numba's cache on disk looks at the file of the kernel only: delete it (`*.nbi`) after changes in this one.
"""

import operator
from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

from foredrive.ops.lanes import inlined_part

ROW = 16
_VECTOR = ir.VectorType(ir.FloatType(), ROW)
_WHOLE = ir.VectorType(cgutils.int32_t, ROW)
_FLAGS = ("contract", "nsz", "reassoc")


class Row(types.Type):
    """Numba type of sixteen float32."""

    def __init__(self) -> None:
        super().__init__(name="Row")


a_row = Row()


@register_model(Row)
class _RowModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _broadcast(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(cgutils.int32_t, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(_WHOLE, [0] * ROW))


def _as_rows(builder: ir.IRBuilder, args: Any) -> list[ir.Value]:
    """Arguments as rows, scalars broadcast."""
    return [value if value.type == _VECTOR else _broadcast(builder, value) for value in args]


def _elementwise(emit: Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]) -> Any:
    """An intrinsic of two rows, one of which may be a float32."""

    @intrinsic
    @no_type_check
    def apply(typing_context, a, b):
        if a_row not in (a, b):
            return None

        def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
            return emit(builder, _as_rows(builder, args))

        kinds = [kind if kind is a_row else types.float32 for kind in (a, b)]
        return a_row(*kinds), codegen

    return apply


def _select(order: str) -> Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]:
    def emit(builder: ir.IRBuilder, args: list[ir.Value]) -> ir.Value:
        return builder.select(builder.fcmp_ordered(order, *args), *args)

    return emit


least = _elementwise(_select("<"))
"""The lesser of each pair; the second where one is NaN."""
greatest = _elementwise(_select(">"))
"""The greater of each pair; the second where one is NaN."""


def _operator(symbol: Any, emit: Callable[[ir.IRBuilder, list[ir.Value]], ir.Value]) -> None:
    apply = _elementwise(emit)

    @overload(symbol)
    @no_type_check
    def implement(a, b):
        if a_row in (a, b) and all(kind is a_row or isinstance(kind, types.Float) for kind in (a, b)):
            return lambda a, b: apply(a, b)
        return None


_operator(operator.add, lambda builder, args: builder.fadd(*args, flags=_FLAGS))
_operator(operator.sub, lambda builder, args: builder.fsub(*args, flags=_FLAGS))
_operator(operator.mul, lambda builder, args: builder.fmul(*args, flags=_FLAGS))
_operator(operator.truediv, lambda builder, args: builder.fdiv(*args, flags=_FLAGS))


@intrinsic
@no_type_check
def row_of(typing_context, scalar):
    """Sixteen times the same."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return _broadcast(builder, args[0])

    return a_row(types.float32), codegen


def _place(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.bitcast(builder.gep(array.data, [args[1]]), _VECTOR.as_pointer())


@intrinsic
@no_type_check
def load_row(typing_context, array, index):
    """Read sixteen numbers from flat `index` of a C-contiguous float32 array. No bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.load(_place(context, builder, signature, args), align=4)

    return a_row(array, types.intp), codegen


@intrinsic
@no_type_check
def store_row(typing_context, array, index, value):
    """Write a row to flat `index` of a C-contiguous float32 array. No bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        builder.store(args[2], _place(context, builder, signature, args), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, a_row), codegen


@intrinsic
@no_type_check
def where_more(typing_context, a, b, yes, no):
    """Numbers of `yes` where a > b, else those of `no`; each a row or a float32."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        a, b, yes, no = _as_rows(builder, args)
        return builder.select(builder.fcmp_ordered(">", a, b), yes, no)

    kinds = [kind if kind is a_row else types.float32 for kind in (a, b, yes, no)]
    return a_row(*kinds), codegen


@intrinsic
@no_type_check
def bits_more(typing_context, a, b):
    """An integer whose bit k says whether number k of a is above that of b."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        above = builder.fcmp_ordered(">", *_as_rows(builder, args))
        return builder.zext(builder.bitcast(above, ir.IntType(ROW)), cgutils.int32_t)

    kinds = [kind if kind is a_row else types.float32 for kind in (a, b)]
    return types.uint32(*kinds), codegen


@intrinsic
@no_type_check
def lowest_bit(typing_context, bits):
    """Place of the lowest bit of an integer that is not 0."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.zext(builder.cttz(args[0], ir.Constant(ir.IntType(1), 1)), cgutils.intp_t)

    return types.intp(types.uint32), codegen


def _halving(pair: Callable[[ir.IRBuilder, ir.Value, ir.Value], ir.Value]) -> Any:
    """An intrinsic that makes one float32 of a row, halves at a time."""

    @intrinsic
    @no_type_check
    def apply(typing_context, row):
        def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
            (value,) = args
            for half in (8, 4, 2, 1):
                other = [(lane + half) % ROW for lane in range(ROW)]
                value = pair(builder, value, builder.shuffle_vector(value, value, ir.Constant(_WHOLE, other)))
            return builder.extract_element(value, ir.Constant(cgutils.int32_t, 0))

        return types.float32(a_row), codegen

    return apply


total_of = _halving(lambda builder, a, b: builder.fadd(a, b, flags=_FLAGS))
"""The sum of a row's numbers."""
greatest_in = _halving(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
"""The greatest of a row's numbers."""


@intrinsic
@no_type_check
def totals(typing_context, array, index):
    """The sums of sixteen rows that follow each other from flat `index` of an array, as one row."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        first = _place(context, builder, signature, args)
        places = [builder.gep(first, [ir.Constant(cgutils.int32_t, k)]) for k in range(ROW)]
        rows = [builder.load(place, align=4) for place in places]
        while len(rows) > 1:  # halve the rows and the lanes that belong to the same row
            run = ROW // len(rows)
            rows = [_add_runs(builder, a, b, run) for a, b in zip(rows[::2], rows[1::2], strict=True)]
        return rows[0]

    return a_row(array, types.intp), codegen


def _add_runs(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, run: int) -> ir.Value:
    """Add neighbouring runs of lanes within a and within b; the sums of a and of b alternate."""
    even = [lane for lane in range(ROW) if lane // run % 2 == 0]
    order = [
        lane + shift for at in range(0, len(even), run) for shift in (0, ROW) for lane in even[at : at + run]
    ]
    halves = ([lane + shift for lane in order] for shift in (0, run))
    picked = (builder.shuffle_vector(a, b, ir.Constant(_WHOLE, lanes)) for lanes in halves)
    return builder.fadd(*picked)


@intrinsic
@no_type_check
def prefetch(typing_context, array, index):
    """Have the cache line at flat `index` of an array come nearer."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        pointer = ir.IntType(8).as_pointer()
        place = builder.bitcast(_place(context, builder, signature, args), pointer)
        flags = [ir.Constant(cgutils.int32_t, k) for k in (0, 3, 1)]  # to read, soon, data
        kind = ir.FunctionType(ir.VoidType(), [pointer, *(flag.type for flag in flags)])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [place, *flags])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
@no_type_check
def _floor(typing_context, row):
    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.floor.v{ROW}f32")
        return builder.call(function, args)

    return a_row(a_row), codegen


@intrinsic
@no_type_check
def _power_of_2(typing_context, row):
    """2^n of whole numbers n from -126 to 127, written into the exponent."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        whole = builder.add(builder.fptosi(args[0], _WHOLE), ir.Constant(_WHOLE, [127] * ROW))
        return builder.bitcast(builder.shl(whole, ir.Constant(_WHOLE, [23] * ROW)), _VECTOR)

    return a_row(a_row), codegen


_C5, _C4, _C3, _C2, _C1 = (
    np.float32(c) for c in (1.86713e-3, 9.01703e-3, 5.579991e-2, 2.4016445e-1, 6.9315131e-1)
)
"""2^f ≈ 1 + f (C1 + f (C2 + …)) for f from 0 to 1, to within 8e-8 of it: the least greatest relative error of
degree 5, found by reweighted least squares."""
_LEAST, _ONE = np.float32(-126), np.float32(1)


@inlined_part
@no_type_check
def exp2_row(x):
    """2^x for x ≤ 127, to within 3e-7 of it; below 2^-126 that."""
    x = greatest(x, _LEAST)
    whole = _floor(x)
    f = x - whole
    polynomial = ((((f * _C5 + _C4) * f + _C3) * f + _C2) * f + _C1) * f + _ONE
    return polynomial * _power_of_2(whole)
