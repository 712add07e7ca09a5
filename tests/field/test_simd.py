"""The portable lanes against the intrinsics, one function at a time, and whole kernels on the portable path."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit

from fieldstone.field.grid import simd_intrinsics, simd_portable
from fieldstone.field.grid.simd_numba import intrinsics_work

pytestmark = pytest.mark.skipif(not intrinsics_work(), reason="this llvmlite cannot build the intrinsics")

NUMBERS = np.random.default_rng(0).normal(size=(3, 16)).astype(np.float32)
NUMBERS[0, 3] = NUMBERS[1, 5] = 0.0


def lanes(simd, name):
    """A kernel that applies one function to lanes 2 to 10 of three rows and writes what comes out."""
    function, load8, load4, store8, store4 = getattr(simd, name), simd.load8, simd.load4, simd.store8, simd.store4
    if name in ("add8", "sub8", "mul8", "div8"):
        return njit(lambda a, b, c, out: store8(out, 0, function(load8(a, 2), load8(b, 2))))
    if name in ("fma8", "where_nonzero8"):
        return njit(lambda a, b, c, out: store8(out, 0, function(load8(a, 2), load8(b, 2), load8(c, 2))))
    if name == "positive8":
        return njit(lambda a, b, c, out: store8(out, 0, function(load8(a, 2))))
    if name == "sqrt8":
        square = simd.mul8
        return njit(lambda a, b, c, out: store8(out, 0, function(square(load8(a, 2), load8(a, 2)))))
    if name == "twice8":
        return njit(lambda a, b, c, out: store8(out, 0, function(load4(a, 2))))
    if name == "fold8":
        return njit(lambda a, b, c, out: store4(out, 0, function(load8(a, 2))))
    if name == "halves8":
        return njit(lambda a, b, c, out: store8(out, 0, function(a[1], b[1])))
    if name == "spread8":
        return njit(lambda a, b, c, out: store8(out, 0, function(a[1])))
    spread8 = simd.spread8
    if name == "spread8_at":
        return njit(lambda a, b, c, out: store8(out, 0, function(a, 7)))
    if name == "at":
        return njit(lambda a, b, c, out: store8(out, 0, spread8(function(a, 7))))
    if name == "prefetch":
        return njit(lambda a, b, c, out: function(a, 7))
    assert name in ("first_lane", "sum8")
    return njit(lambda a, b, c, out: store8(out, 0, spread8(function(load8(a, 2)))))


EXPECTED = {
    "add8": lambda a, b, c: a + b,
    "sub8": lambda a, b, c: a - b,
    "mul8": lambda a, b, c: a * b,
    "div8": lambda a, b, c: a / b,
    "fma8": lambda a, b, c: a * b + c,
    "where_nonzero8": lambda a, b, c: np.where(a != 0, b, c),
    "positive8": lambda a, b, c: np.maximum(a, 0),
    "sqrt8": lambda a, b, c: np.abs(a),
    "twice8": lambda a, b, c: np.tile(a[:4], 2),
    "fold8": lambda a, b, c: np.append(a[:4] + a[4:], np.zeros(4)),
    "first_lane": lambda a, b, c: np.full(8, a[0]),
    "sum8": lambda a, b, c: np.full(8, a.sum()),
    "halves8": lambda a, b, c: np.repeat([NUMBERS[0, 1], NUMBERS[1, 1]], 4),
    "spread8": lambda a, b, c: np.full(8, NUMBERS[0, 1]),
    "spread8_at": lambda a, b, c: np.full(8, NUMBERS[0, 7]),
    "at": lambda a, b, c: np.full(8, NUMBERS[0, 7]),
    "prefetch": lambda a, b, c: np.zeros(8),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_both_paths_do_what_they_say(name):
    """The same bits but for `fma8`, which the intrinsics round once; the reference is float64."""
    found = []
    for simd in (simd_intrinsics, simd_portable):
        out = np.zeros(8, dtype=np.float32)
        lanes(simd, name)(NUMBERS[0], NUMBERS[1], NUMBERS[2], out)
        found.append(out)
    with np.errstate(divide="ignore"):
        expected = EXPECTED[name](*NUMBERS[:, 2:10].astype(np.float64))
    for out in found:
        np.testing.assert_allclose(out, expected, rtol=1e-5, atol=1e-6)
    if name != "fma8":
        np.testing.assert_array_equal(*found)


def test_both_paths_offer_the_same_functions():
    from fieldstone.field.grid import simd_numba

    for name in simd_numba.__all__:
        assert callable(getattr(simd_portable, name))
        assert getattr(simd_numba, name) is getattr(simd_intrinsics, name)
    assert {"load4", "load8", "store4", "store8", *EXPECTED} == set(simd_numba.__all__)


def test_intrinsics_that_cannot_be_built_are_left_alone(monkeypatch, caplog):
    def refused(values, out):
        raise TypeError("typed pointers are gone")

    monkeypatch.setattr(simd_intrinsics, "copied", refused)
    assert not intrinsics_work()
    assert "typed pointers are gone" in caplog.text


@pytest.mark.slow
def test_gradients_are_right_on_the_portable_path(tmp_path):
    """All kernels of a step, compiled anew on plain numba, against autograd and finite differences."""
    environment = os.environ | {"FIELDSTONE_SIMD": "portable", "NUMBA_CACHE_DIR": str(tmp_path)}
    tests = ["tests/field/test_grid_gradients.py", "tests/field/test_grid_layout.py"]
    run = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests]
    found = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout[-3000:]
