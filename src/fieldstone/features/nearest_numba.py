"""The two nearest neighbours of every descriptor, both ways, near the floor of the machine.

n * m * d multiply-adds cannot be avoided; what can is waiting for memory. A tile of 4 x 24 dot products is summed in
registers and compared at once with the best two so far of its rows and of its columns, so that no distance is ever
stored. Each 32-bit lane takes some neighbouring products per step:

- two of 16-bit numbers, anywhere. LLVM turns the products and sums of neighbours below into the machine's instruction
  for them (vpmaddwd on x86, smull and addp on ARM); loops in Python that it would recognise as well as these lines do
  not exist, hence the intrinsic.
- four of bytes, where the machine has vpdpbusd (x86 since about 2021): half the instructions and half the memory. One
  side must be signed, so b - 128 stands for b; what that changes is the same for all of b, and goes into |a|^2.

Both are exact, and give the same answer.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from jaxtyping import Int, UInt8
from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from fieldstone.features.nearest import NO_SECOND, TwoNearest, check_descriptors

LANES = 8
"""32-bit numbers in one vector."""
TILE_ROWS = 4
TILE_COLUMNS = 3 * LANES
BLOCK_ROWS = 256
"""Rows that stay in the second-level cache while all columns pass by (64 kB)."""

CPU_FEATURES = cpu_target.target_context.codegen().magic_tuple()[2].split(",")  # pyright: ignore[reportAttributeAccessIssue]
HAS_BYTE_PRODUCTS = "+avxvnni" in CPU_FEATURES or {"+avx512vnni", "+avx512vl"} <= set(CPU_FEATURES)
"""Whether kernels may use vpdpbusd on vectors of `LANES`."""
SHIFT = 128
"""What is taken from the bytes of b to make them signed."""

if HAS_BYTE_PRODUCTS:
    binding.initialize_native_asmparser()

I32, I64 = ir.IntType(32), ir.IntType(64)
SUMS = ir.VectorType(I32, LANES)
PRODUCTS = ir.VectorType(I32, 2 * LANES)
PAIRS = ir.VectorType(ir.IntType(16), 2 * LANES)


def two_nearest_numba(
    a: UInt8[np.ndarray, "n d"], b: UInt8[np.ndarray, "m d"], *, by_bytes: bool = HAS_BYTE_PRODUCTS
) -> tuple[TwoNearest, TwoNearest]:
    """The two nearest neighbours of each row of a in b, and of each row of b in a; lower indices win ties."""
    check_descriptors(a, b)
    # |a - b|^2 = |a|^2 - (2 a . b - |b|^2): for a fixed row of a, the largest score 2 a . b - |b|^2 is the nearest.
    values = 4 if by_bytes else 2
    padded_a, padded_b = _padded(a, TILE_ROWS, values), _padded(b, TILE_COLUMNS, values)
    norm_a, norm_b = _norms(a, len(padded_a)), _norms(b, len(padded_b))
    if by_bytes:
        # a . b = a . (b - 128) + 128 sum(a)
        norm_a[: len(a)] -= 2 * SHIFT * a.sum(axis=1, dtype=np.int32)
        padded_b = (padded_b ^ SHIFT).view(np.int8)
    else:
        padded_a, padded_b = padded_a.astype(np.int16), padded_b.astype(np.int16)
    panels_b = padded_b.reshape(len(padded_b) // TILE_COLUMNS, TILE_COLUMNS, -1, values).transpose(0, 2, 1, 3)
    rows, columns = _empty_ranking(len(padded_a)), _empty_ranking(len(padded_b) // LANES)
    _rank_numba(padded_a, np.ascontiguousarray(panels_b), norm_a, norm_b, rows, columns, BLOCK_ROWS)
    return _best_lane(rows, norm_a, len(a)), _every_lane(columns, norm_b, len(b))


def _padded(descriptors: UInt8[np.ndarray, "n d"], rows: int, values: int) -> UInt8[np.ndarray, "_ _"]:
    """Zero rows and columns up to multiples of `rows` and `values`."""
    n, d = descriptors.shape
    out = np.zeros((-(-n // rows) * rows, -(-d // values) * values), dtype=np.uint8)
    out[:n, :d] = descriptors
    return out


def _norms(descriptors: UInt8[np.ndarray, "n d"], length: int) -> Int[np.ndarray, "_"]:
    """Squared norms; padding gets one so large that it is never near."""
    out = np.full(length, NO_SECOND, dtype=np.int32)
    out[: len(descriptors)] = np.einsum("nd,nd->n", descriptors, descriptors, dtype=np.int32)
    return out


def _empty_ranking(length: int) -> Int[np.ndarray, "n 3 8"]:
    """Per row or group of columns and lane: best score, second score, index of the best."""
    out = np.empty((length, 3, LANES), dtype=np.int32)
    out[:, :2], out[:, 2] = -NO_SECOND, 0
    return out


def _best_lane(rows: Int[np.ndarray, "_ 3 8"], norm: Int[np.ndarray, "_"], n: int) -> TwoNearest:
    """The lanes of a row have ranked every eighth column: rank them against each other."""
    best, second, index = rows[:n, 0], rows[:n, 1], rows[:n, 2]
    # Largest score, then lowest index: as one integer.
    winner = np.argmax(best.astype(np.int64) * 2**31 - index, axis=1)
    at = np.arange(n)
    rest = best.copy()
    rest[at, winner] = second[at, winner]
    return _as_distances(best[at, winner], rest.max(axis=1), index[at, winner], norm[:n])


def _every_lane(columns: Int[np.ndarray, "_ 3 8"], norm: Int[np.ndarray, "_"], m: int) -> TwoNearest:
    """Each lane of a group of columns is one column."""
    best, second, index = (columns[:, k].reshape(-1)[:m] for k in range(3))
    return _as_distances(best, second, index, norm[:m])


def _as_distances(best, second, index, norm: Int[np.ndarray, "n"]) -> TwoNearest:
    squared = norm.astype(np.int64)
    beyond = np.where(second == -NO_SECOND, NO_SECOND, squared - second)
    return TwoNearest(index.astype(np.int64), squared - best, beyond)


@njit(cache=True, nogil=True)
@no_type_check
def _rank_numba(a, panels_b, norm_a, norm_b, rows, columns, block):
    """Fill the rankings.  a (n, d) int16 or uint8;  panels_b (m / 24, d / k, 24, k) int16, k = 2, or int8, k = 4."""
    n, m, num_steps = a.shape[0], norm_b.shape[0], panels_b.shape[1]
    for start in range(0, n, block):
        stop = min(start + block, n)
        for j in range(0, m, TILE_COLUMNS):
            for i in range(start, stop, TILE_ROWS):
                _rank_tile(a, panels_b, norm_a, norm_b, rows, columns, i, j, num_steps)


@intrinsic
@no_type_check
def _rank_tile(typing_context, a, panels_b, norm_a, norm_b, rows, columns, i, j, num_steps):
    """Score rows i..i+3 against columns j..j+23 and enter them into the rankings of both."""
    signature = types.void(a, panels_b, norm_a, norm_b, rows, columns, i, j, num_steps)
    add_products = _add_four_products if a.dtype == types.uint8 else _add_two_products

    def generate(context, builder, signature, args):
        data = [context.make_array(t)(context, builder, v).data for t, v in zip(signature.args[:6], args[:6])]  # noqa: B905
        i, j, num_steps = args[6:]
        dots = _dot_tile(builder, data[0], data[1], i, j, num_steps, add_products)
        _enter(builder, dots, data[2:], i, j)
        return context.get_dummy_value()

    return signature, generate


@no_type_check
def _dot_tile(builder, a, panels_b, i, j, num_steps, add_products):
    """The 4 x 3 vectors of dot products of a tile."""
    groups = TILE_COLUMNS // LANES
    a, panels_b = (builder.bitcast(p, ir.PointerType(I32)) for p in (a, panels_b))
    sums = [
        [cgutils.alloca_once_value(builder, ir.Constant(SUMS, [0] * LANES)) for _ in range(groups)]
        for _ in range(TILE_ROWS)
    ]
    row_start = [builder.mul(builder.add(i, I64(r)), num_steps) for r in range(TILE_ROWS)]
    panel_start = builder.mul(j, num_steps)
    for row in sums:
        for total in row:
            builder.store(ir.Constant(SUMS, [0] * LANES), total)
    with cgutils.for_range(builder, num_steps, intp=I64) as loop:
        at = builder.add(panel_start, builder.mul(loop.index, I64(TILE_COLUMNS)))
        across = [_load(builder, panels_b, at, g) for g in range(groups)]
        for r in range(TILE_ROWS):
            down = _splat(builder, builder.load(builder.gep(a, [builder.add(row_start[r], loop.index)])))
            for g in range(groups):
                builder.store(add_products(builder, builder.load(sums[r][g]), down, across[g]), sums[r][g])
    return [[builder.load(total) for total in row] for row in sums]


@no_type_check
def _enter(builder, dots, data, i, j):
    """Compare a tile's scores with the best two of its rows and columns."""
    norm_a, norm_b, rows, columns = data
    groups = TILE_COLUMNS // LANES
    group_at = [builder.mul(builder.add(j, I64(g * LANES)), I64(3)) for g in range(groups)]
    by_column = [_load_ranking(builder, columns, at) for at in group_at]
    norms = [_load(builder, norm_b, j, g) for g in range(groups)]
    j_splat = _splat(builder, builder.trunc(j, I32))
    j_lanes = [builder.add(j_splat, ir.Constant(SUMS, [g * LANES + k for k in range(LANES)])) for g in range(groups)]
    for r in range(TILE_ROWS):
        row = builder.add(i, I64(r))
        row_at = builder.mul(row, I64(3 * LANES))
        by_row = _load_ranking(builder, rows, row_at)
        norm = _splat(builder, builder.load(builder.gep(norm_a, [row])))
        i_splat = _splat(builder, builder.trunc(row, I32))
        for g in range(groups):
            twice = builder.add(dots[r][g], dots[r][g])
            by_row = _ranked(builder, by_row, builder.sub(twice, norms[g]), j_lanes[g])
            by_column[g] = _ranked(builder, by_column[g], builder.sub(twice, norm), i_splat)
        _store_ranking(builder, by_row, rows, row_at)
    for g in range(groups):
        _store_ranking(builder, by_column[g], columns, group_at[g])


@no_type_check
def _ranked(builder, ranking, score, index):
    """(best, second, index of best) after one more score; an equal one comes second."""
    best, second, best_index = ranking
    better = builder.icmp_signed(">", score, best)
    lower = builder.select(better, best, score)
    second = builder.select(builder.icmp_signed(">", lower, second), lower, second)
    return builder.select(better, score, best), second, builder.select(better, index, best_index)


@no_type_check
def _add_four_products(builder, total, x, y):
    """Each lane plus the sum of the products of its four bytes, unsigned in x and signed in y."""
    # As assembly, since the types of LLVM's own function for it differ between versions.
    kind = ir.FunctionType(SUMS, [SUMS, SUMS, SUMS])
    return builder.asm(kind, "vpdpbusd $3, $2, $0", "=x,0,x,x", [total, x, y], side_effect=False)


@no_type_check
def _add_two_products(builder, total, x, y):
    """Each lane plus the sum of the products of its two 16-bit numbers."""
    x, y = (builder.sext(builder.bitcast(v, PAIRS), PRODUCTS) for v in (x, y))
    products = builder.mul(x, y)
    even, odd = (
        builder.shuffle_vector(
            products, ir.Constant(PRODUCTS, ir.Undefined), ir.Constant(SUMS, list(range(k, 2 * LANES, 2)))
        )
        for k in (0, 1)
    )
    return builder.add(total, builder.add(even, odd))


@no_type_check
def _splat(builder, scalar):
    """One number in all lanes."""
    undefined = ir.Constant(SUMS, ir.Undefined)
    return builder.shuffle_vector(
        builder.insert_element(undefined, scalar, I32(0)), undefined, ir.Constant(SUMS, [0] * LANES)
    )


@no_type_check
def _load(builder, pointer, offset, group):
    """The vector number `group` after an offset."""
    at = builder.gep(pointer, [builder.add(offset, I64(group * LANES))])
    value = builder.load(builder.bitcast(at, ir.PointerType(SUMS)))
    value.align = 4
    return value


@no_type_check
def _load_ranking(builder, pointer, offset):
    """(best, second, index) of a row's lanes or of a group of columns."""
    return tuple(_load(builder, pointer, offset, k) for k in range(3))


@no_type_check
def _store_ranking(builder, ranking, pointer, offset):
    """Write what `_load_ranking` reads."""
    for k, value in enumerate(ranking):
        at = builder.gep(pointer, [builder.add(offset, I64(k * LANES))])
        store = builder.store(value, builder.bitcast(at, ir.PointerType(SUMS)))
        store.align = 4
