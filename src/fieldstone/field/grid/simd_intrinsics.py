"""The lanes of `simd_numba` as LLVM vectors: loads, stores and arithmetic of one instruction each.

LLVM does not turn loops of four or eight entries over tables with computed rows into vector code by itself (it cannot
know that they do not overlap), and such loops are all that a feature grid does. Each function here is one LLVM
operation on <8 x float> (or <4 x float>), so results do not depend on what an optimiser dares: no fast-math, the only
fused operation is `fma8`, and its single rounding is the same on every CPU with FMA.

The functions exist only inside `@njit` code; there is no bounds check. Measured against scalar loops: the eight
corners of a grid cell, 4 channels each, take 8 ns instead of 40.
"""

from __future__ import annotations

from typing import Any, no_type_check

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

FLOAT = ir.FloatType()
INT = ir.IntType(32)
VECTOR4 = ir.VectorType(FLOAT, 4)
VECTOR8 = ir.VectorType(FLOAT, 8)


class LanesType(types.Opaque):
    """The numba type of a vector of float32 lanes."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        super().__init__(name=f"float32x{lanes}")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: LanesType) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(FLOAT, fe_type.lanes))


FLOAT32X4 = LanesType(4)
FLOAT32X8 = LanesType(8)


def _element(context: Any, builder: Any, array_type: Any, array: Any, index_type: Any, index: Any) -> Any:
    """Pointer to array[index] of a contiguous array seen as flat, without bounds check or wrap-around."""
    data = cgutils.create_struct_proxy(array_type)(context, builder, array).data
    element = context.get_data_type(array_type.dtype)
    offset = context.cast(builder, index, index_type, types.intp)
    return builder.gep(data, [offset], source_etype=element)


def _pointing_to(builder: Any, pointer: Any, pointee: Any) -> Any:
    """The pointer for a load or store of another type: opaque ones, which know no type, are that already."""
    return pointer if getattr(pointer.type, "is_opaque", False) else builder.bitcast(pointer, pointee.as_pointer())


def _is_float32_array(array: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype == types.float32 and array.layout == "C"


def _shuffled(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(lanes)), lanes))


def _undefined(vector: Any) -> Any:
    return ir.Constant(vector, ir.Undefined)


def _spread(builder: Any, scalar: Any, lanes: int) -> Any:
    """The scalar in every lane."""
    vector = ir.VectorType(FLOAT, lanes)
    first = builder.insert_element(_undefined(vector), scalar, ir.Constant(INT, 0))
    return _shuffled(builder, first, _undefined(vector), [0] * lanes)


def _load(lanes_type: LanesType, vector: Any) -> Any:
    def load(typingctx, array, index):
        if not _is_float32_array(array):
            return None

        def codegen(context, builder, sig, args):
            pointer = _element(context, builder, sig.args[0], args[0], sig.args[1], args[1])
            return builder.load(_pointing_to(builder, pointer, vector), align=4, typ=vector)

        return lanes_type(array, index), codegen

    return intrinsic(load)


def _store() -> Any:
    def store(typingctx, array, index, value):
        if not _is_float32_array(array):
            return None

        def codegen(context, builder, sig, args):
            pointer = _element(context, builder, sig.args[0], args[0], sig.args[1], args[1])
            builder.store(args[2], _pointing_to(builder, pointer, args[2].type), align=4)
            return context.get_dummy_value()

        return types.none(array, index, value), codegen

    return intrinsic(store)


load8 = _load(FLOAT32X8, VECTOR8)
"""load8(array, i): array[i:i + 8] of a flat float32 array."""
load4 = _load(FLOAT32X4, VECTOR4)
"""load4(array, i): array[i:i + 4]."""
store8 = _store()
"""store8(array, i, v): array[i:i + 8] = v."""
store4 = _store()
"""store4(array, i, v): array[i:i + 4] = v."""


def _binary(operation: str) -> Any:
    def apply(typingctx, a, b):
        def codegen(context, builder, sig, args):
            return getattr(builder, operation)(args[0], args[1])

        return a(a, b), codegen

    return intrinsic(apply)


add8, sub8, mul8, div8 = _binary("fadd"), _binary("fsub"), _binary("fmul"), _binary("fdiv")


def _called(builder: Any, name: str, args: Any) -> Any:
    vector = args[0].type
    signature = ir.FunctionType(vector, [vector] * len(args))
    function = cgutils.get_or_insert_function(builder.module, signature, f"{name}.v{vector.count}f32")
    return builder.call(function, args)


@intrinsic
def fma8(typingctx, a, b, c):
    """fma8(a, b, c) = a b + c, rounded once."""

    def codegen(context, builder, sig, args):
        return _called(builder, "llvm.fma", args)

    return a(a, b, c), codegen


@intrinsic
def sqrt8(typingctx, a):
    """Square roots."""

    def codegen(context, builder, sig, args):
        return _called(builder, "llvm.sqrt", args)

    return a(a), codegen


@intrinsic
def positive8(typingctx, a):
    """max(a, 0)."""

    def codegen(context, builder, sig, args):
        zero = ir.Constant(args[0].type, None)
        return builder.select(builder.fcmp_ordered(">", args[0], zero), args[0], zero)

    return a(a), codegen


@intrinsic
def where_nonzero8(typingctx, test, a, b):
    """A lane of `a` where the lane of `test` is not 0, else of `b`."""

    def codegen(context, builder, sig, args):
        nonzero = builder.fcmp_unordered("!=", args[0], ir.Constant(args[0].type, None))
        return builder.select(nonzero, args[1], args[2])

    return a(test, a, b), codegen


@intrinsic
def spread8(typingctx, scalar):
    """The scalar in all 8 lanes, as float32."""

    def codegen(context, builder, sig, args):
        return _spread(builder, context.cast(builder, args[0], sig.args[0], types.float32), 8)

    return FLOAT32X8(scalar), codegen


@intrinsic
def spread8_at(typingctx, array, index):
    """array[index] in all 8 lanes."""
    if not _is_float32_array(array):
        return None

    def codegen(context, builder, sig, args):
        pointer = _element(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        return _spread(builder, builder.load(pointer, typ=FLOAT), 8)

    return FLOAT32X8(array, index), codegen


@intrinsic
def halves8(typingctx, low, high):
    """(low, low, low, low, high, high, high, high)."""

    def codegen(context, builder, sig, args):
        a = context.cast(builder, args[0], sig.args[0], types.float32)
        b = context.cast(builder, args[1], sig.args[1], types.float32)
        first = builder.insert_element(_undefined(VECTOR8), a, ir.Constant(INT, 0))
        both = builder.insert_element(first, b, ir.Constant(INT, 1))
        return _shuffled(builder, both, _undefined(VECTOR8), [0] * 4 + [1] * 4)

    return FLOAT32X8(low, high), codegen


@intrinsic
def twice8(typingctx, v):
    """(v, v) from four lanes."""

    def codegen(context, builder, sig, args):
        return _shuffled(builder, args[0], _undefined(VECTOR4), [0, 1, 2, 3] * 2)

    return FLOAT32X8(v), codegen


@intrinsic
def fold8(typingctx, v):
    """Low four lanes plus high four lanes."""

    def codegen(context, builder, sig, args):
        low = _shuffled(builder, args[0], _undefined(VECTOR8), [0, 1, 2, 3])
        return builder.fadd(low, _shuffled(builder, args[0], _undefined(VECTOR8), [4, 5, 6, 7]))

    return FLOAT32X4(v), codegen


@intrinsic
def first_lane(typingctx, v):
    """Lane 0."""

    def codegen(context, builder, sig, args):
        return builder.extract_element(args[0], ir.Constant(INT, 0))

    return types.float32(v), codegen


@intrinsic
def sum8(typingctx, v):
    """Sum of the 8 lanes, always in the same order."""

    def codegen(context, builder, sig, args):
        value, count = args[0], 8
        while count > 1:
            count //= 2
            low = _shuffled(builder, value, _undefined(value.type), list(range(count)))
            value = builder.fadd(low, _shuffled(builder, value, _undefined(value.type), list(range(count, 2 * count))))
        return builder.extract_element(value, ir.Constant(INT, 0))

    return types.float32(v), codegen


@intrinsic
def at(typingctx, array, index):
    """array[index] of a C-contiguous array seen as flat, without the test for negative indices."""
    if not (isinstance(array, types.Array) and array.layout == "C"):
        return None

    def codegen(context, builder, sig, args):
        pointer = _element(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        return builder.load(pointer, typ=context.get_data_type(array.dtype))

    return array.dtype(array, index), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Ask for the cache line of array[index]; changes no value."""

    def codegen(context, builder, sig, args):
        pointer = _element(context, builder, sig.args[0], args[0], sig.args[1], args[1])
        pointer = _pointing_to(builder, pointer, ir.IntType(8))
        signature = ir.FunctionType(ir.VoidType(), [pointer.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, signature, "llvm.prefetch.p0")
        builder.call(function, [pointer, ir.Constant(INT, 0), ir.Constant(INT, 3), ir.Constant(INT, 1)])
        return context.get_dummy_value()

    return types.none(array, index), codegen


@njit(cache=True)
@no_type_check
def copied(values, out):
    """Uses loads, stores and a prefetch: where the intrinsics cannot be built, it cannot be compiled."""
    prefetch(values, 0)  # pyright: ignore[reportCallIssue]
    store4(out, 0, load4(values, 0))
    return first_lane(load4(values, 0))
