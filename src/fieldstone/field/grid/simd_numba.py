"""Eight float32 lanes at a time inside numba kernels, by LLVM vectors where they can be built.

| function | result |
|---|---|
| `load8(array, i)`, `load4(array, i)` | array[i:i + 8] and array[i:i + 4] of a flat float32 array |
| `store8(array, i, v)`, `store4(array, i, v)` | the same, written |
| `at(array, i)` | array[i] of a contiguous array seen as flat; i is not negative |
| `prefetch(array, i)` | asks for the cache line of array[i]; changes no value |
| `add8`, `sub8`, `mul8`, `div8`, `sqrt8` | lane by lane |
| `fma8(a, b, c)` | a b + c |
| `positive8(a)` | max(a, 0) |
| `where_nonzero8(test, a, b)` | a lane of a where the lane of test is not 0, else of b |
| `spread8(x)`, `spread8_at(array, i)` | one number in all lanes |
| `halves8(x, y)`, `twice8(v)` | (x, x, x, x, y, y, y, y); (v, v) from four lanes |
| `fold8(v)` | low four lanes plus high four lanes |
| `first_lane(v)`, `sum8(v)` | lane 0; the sum of all lanes, always in the same order |

They exist only inside `@njit` code; there is no bounds check. `simd_intrinsics` builds them from LLVM instructions,
`simd_portable` from plain numba, with results that differ by the rounding of `fma8`. The former need a version of
llvmlite with opaque pointers; whether they work is tried once. FIELDSTONE_SIMD=portable chooses the latter.
"""

from __future__ import annotations

import logging
import os

import numpy as np
from numba.core.errors import NumbaError

logger = logging.getLogger(__name__)

VARIABLE, PORTABLE = "FIELDSTONE_SIMD", "portable"


def intrinsics_work() -> bool:
    """Whether LLVM takes the intrinsics, tried on four numbers."""
    try:
        from fieldstone.field.grid.simd_intrinsics import copied

        values, out = np.arange(1, 5, dtype=np.float32), np.zeros(4, dtype=np.float32)
        return copied(values, out) == 1.0 and bool(np.array_equal(values, out))
    except (ImportError, AttributeError, TypeError, NotImplementedError, RuntimeError, NumbaError) as error:
        logger.warning("kernels run without SIMD instructions, several times slower: %s", str(error).split("\n")[0])
        return False


if os.environ.get(VARIABLE) != PORTABLE and intrinsics_work():
    from fieldstone.field.grid.simd_intrinsics import (
        add8,
        at,
        div8,
        first_lane,
        fma8,
        fold8,
        halves8,
        load4,
        load8,
        mul8,
        positive8,
        prefetch,
        spread8,
        spread8_at,
        sqrt8,
        store4,
        store8,
        sub8,
        sum8,
        twice8,
        where_nonzero8,
    )
else:
    from fieldstone.field.grid.simd_portable import (
        add8,
        at,
        div8,
        first_lane,
        fma8,
        fold8,
        halves8,
        load4,
        load8,
        mul8,
        positive8,
        prefetch,
        spread8,
        spread8_at,
        sqrt8,
        store4,
        store8,
        sub8,
        sum8,
        twice8,
        where_nonzero8,
    )

__all__ = [
    "add8",
    "at",
    "div8",
    "first_lane",
    "fma8",
    "fold8",
    "halves8",
    "load4",
    "load8",
    "mul8",
    "positive8",
    "prefetch",
    "spread8",
    "spread8_at",
    "sqrt8",
    "store4",
    "store8",
    "sub8",
    "sum8",
    "twice8",
    "where_nonzero8",
]
