"""Damage to files, drawn from a seed: every reader must end in an InputError or in a correct load."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fieldstone.errors import InputError


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """One random damage: truncated, bits flipped, bytes overwritten, dropped, doubled or extreme, digits changed."""
    out = bytearray(data)
    kind = rng.integers(7)
    a, b = sorted(int(i) for i in rng.integers(0, len(data) + 1, size=2))
    b = min(b, a + 64)
    if kind == 0:
        return data[:a]
    if kind == 1:
        for i in rng.integers(0, len(data), size=rng.integers(1, 8)):
            out[i] ^= 1 << rng.integers(8)
    elif kind == 2:
        out[a:b] = rng.integers(0, 256, size=b - a, dtype=np.uint8).tobytes()
    elif kind == 3:
        del out[a:b]
    elif kind == 4:
        out[a:a] = out[a:b]
    elif kind == 5:
        # The largest and the smallest values are what counts and sizes are most sensitive to.
        out[a:b] = bytes([int(rng.choice([0, 0xFF, 0x7F]))]) * (b - a)
    else:
        digits = [i for i, byte in enumerate(data) if 48 <= byte <= 57] or [0]
        for i in rng.choice(digits, size=rng.integers(1, 4)):
            out[i] = b"0123456789-. eN"[rng.integers(15)]
    return bytes(out)


def check_mutations(
    path: Path, read: Callable[[], Any], check: Callable[[Any], None], *, count: int, seed: int = 0
) -> tuple[int, int]:
    """Damage `path` `count` times; `read` raises InputError or gives what `check` accepts.

    The message must name the file. Returns how many were loaded and how many refused; the file is restored.
    """
    original = path.read_bytes()
    loaded = refused = 0
    try:
        for k in range(count):
            path.write_bytes(mutate(original, np.random.default_rng([seed, k])))
            try:
                result = read()
            except InputError as error:
                message = str(error)
                refused += 1
            else:
                check(result)
                loaded += 1
                continue
            assert str(path.parent) in message, f"mutation {k}: {message!r} does not name the file"
            assert "\n" not in message, f"mutation {k}: more than one line: {message!r}"
    finally:
        path.write_bytes(original)
    return loaded, refused
