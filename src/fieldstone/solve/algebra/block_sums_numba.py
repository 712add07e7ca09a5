"""Sums over blocks of numbers, in vector registers and in one fixed order.

LLVM keeps the order in which sums are written, one addition after the other, unless it is allowed to change it. Such
a permit is not worth its bits: a kernel exists once for every kernel that calls it, each copy is optimised on its
own, and which copy runs depends on what was compiled or loaded before. Here the order is part of the source: number
c of a block goes to lane c mod 8, and the lanes are added in pairs at the end.
"""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

BLOCK = 64
"""Numbers in a block."""
LANES = 8

F64 = ir.DoubleType()
VECTOR = ir.VectorType(F64, LANES)


@intrinsic
def block_sum(typing_context, values, begin):  # (n,), int -> sum of values[begin : begin + BLOCK]
    """Sum of one block of a contiguous array; there must be that many numbers."""
    if not _is_row(values):
        return None

    def generate(context, builder, signature, arguments):
        block = _Block(context, builder, signature.args[0], arguments[0], arguments[1])
        return _total(builder, [block.lanes(k) for k in range(0, BLOCK, LANES)])

    return types.float64(values, types.int64), generate


@intrinsic
def block_dot(typing_context, values, begin1, begin2):  # (n,), int, int -> scalar product of two blocks of values
    """Scalar product of two blocks of a contiguous array."""
    if not _is_row(values):
        return None

    def generate(context, builder, signature, arguments):
        array, first, second = arguments
        block1 = _Block(context, builder, signature.args[0], array, first)
        block2 = _Block(context, builder, signature.args[0], array, second)
        return _total(builder, [builder.fmul(block1.lanes(k), block2.lanes(k)) for k in range(0, BLOCK, LANES)])

    return types.float64(values, types.int64, types.int64), generate


class _Block:
    """A block in memory, as vectors."""

    def __init__(self, context, builder, array_type, array, begin) -> None:
        self.builder = builder
        data = context.make_array(array_type)(context, builder, array).data
        self.start = builder.gep(data, [begin])

    def lanes(self, offset: int):
        """Numbers `offset` to `offset + LANES`."""
        place = self.builder.gep(self.start, [ir.Constant(ir.IntType(64), offset)])
        return self.builder.load(self.builder.bitcast(place, VECTOR.as_pointer()), align=8)


def _total(builder, vectors):
    """Sum of vectors, lane by lane, then of the lanes in pairs."""
    total = vectors[0]
    for vector in vectors[1:]:
        total = builder.fadd(total, vector)
    lanes = [builder.extract_element(total, ir.Constant(ir.IntType(32), k)) for k in range(LANES)]
    while len(lanes) > 1:
        lanes = [builder.fadd(a, b) for a, b in zip(lanes[::2], lanes[1::2], strict=True)]
    return lanes[0]


def _is_row(values) -> bool:
    is_flat = isinstance(values, types.Array) and values.ndim == 1 and values.layout == "C"
    return is_flat and values.dtype == types.float64
