"""Vectors of two or four float32 numbers in numba kernels: the features of one row of a hash grid.

They add to `vectors`, whose `load`, `store` and `mul_add` accept them too. `load_lanes`, `store_lanes` and
`dot` also accept a plain float32 and a vector of eight, so that one kernel serves any number of features.
"""

from typing import Any, no_type_check

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from foredrive.ops.vectors import Vector

float32x2, float32x4 = Vector(2), Vector(4)
_CONTRACT = ("contract", "nsz")


def _zeros(kind: Vector) -> Any:
    @intrinsic
    @no_type_check
    def zeros(typing_context):
        return kind(), lambda *_: ir.Constant(kind.form, [0.0] * kind.form.count)

    return zeros


zeros2, zeros4 = _zeros(float32x2), _zeros(float32x4)


def _lanes(value: types.Type) -> int:
    return int(value.form.count) if isinstance(value, Vector) else 1


def _place(context: Any, builder: ir.IRBuilder, signature: Any, args: Any, lane: int) -> ir.Value:
    """Return the address of lane `lane`: flat index args[1] + lane · args[2] of array args[0]."""
    array = context.make_array(signature.args[0])(context, builder, args[0])
    step = builder.mul(args[2], ir.Constant(cgutils.intp_t, lane))
    return builder.gep(array.data, [builder.add(args[1], step)])


@intrinsic
@no_type_check
def load_lanes(typing_context, array, index, stride, like):
    """Read a value of `like`'s type whose lanes lie `stride` numbers apart, without a bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        # One scalar load per lane, `stride` apart
        read = [builder.load(_place(context, builder, signature, args, k)) for k in range(_lanes(like))]
        if not isinstance(like, Vector):
            return read[0]
        value = ir.Constant(like.form, ir.Undefined)
        for lane, number in enumerate(read):
            value = builder.insert_element(value, number, ir.Constant(cgutils.int32_t, lane))
        return value

    return like(array, types.intp, types.intp, like), codegen


@intrinsic
@no_type_check
def store_lanes(typing_context, array, index, stride, value):
    """Write the lanes of a value `stride` numbers apart, without a bounds check."""

    def codegen(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        for lane in range(_lanes(value)):
            place = _place(context, builder, signature, args, lane)
            builder.store(_lane(builder, args[3], lane), place)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, value), codegen


def _lane(builder: ir.IRBuilder, value: ir.Value, lane: int) -> ir.Value:
    if not isinstance(value.type, ir.VectorType):
        return value
    return builder.extract_element(value, ir.Constant(cgutils.int32_t, lane))


def _emit_dot(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    product = builder.fmul(a, b, flags=_CONTRACT)
    total = _lane(builder, product, 0)
    for lane in range(1, a.type.count if isinstance(a.type, ir.VectorType) else 1):
        total = builder.fadd(total, _lane(builder, product, lane), flags=_CONTRACT)
    return total


@intrinsic
@no_type_check
def dot(typing_context, a, b):
    """Return the sum of the products of two values' lanes."""
    return types.float32(a, a), lambda context, builder, signature, args: _emit_dot(builder, *args)
