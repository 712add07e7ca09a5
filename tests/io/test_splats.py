"""Splats to a file, read back byte by byte."""

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.rotation import from_wxyz, random_rotation
from fieldstone.io.shapes.splats import PROPERTIES, write_splats
from fieldstone.scene.splats import NUM_SH, Splats


def test_a_file_says_what_the_splats_are(tmp_path):
    rng = np.random.default_rng(0)
    n = 5
    splats = Splats(
        rng.normal(size=(n, 3)), random_rotation(n, rng), rng.uniform(0.01, 1, (n, 3)), rng.uniform(0.1, 0.9, n),
        rng.normal(size=(n, NUM_SH, 3)),
    )  # fmt: skip
    write_splats(splats, tmp_path / "splats.ply")
    header, data = (tmp_path / "splats.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    names = [line.split()[-1] for line in lines[3:]]
    assert len(names) == 62
    assert tuple(names) == PROPERTIES
    column = dict(zip(names, np.frombuffer(data, "<f4").reshape(n, 62).T, strict=True))

    def columns(*wanted):
        return np.stack([column[name] for name in wanted], axis=1)

    np.testing.assert_allclose(columns("x", "y", "z"), splats.means, rtol=1e-6)
    np.testing.assert_allclose(np.exp(columns("scale_0", "scale_1", "scale_2")), splats.scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-column["opacity"])), splats.opacities, rtol=1e-5)
    found = from_wxyz(columns("rot_0", "rot_1", "rot_2", "rot_3").astype(np.float64))
    np.testing.assert_allclose(found, splats.axes, atol=1e-6)
    np.testing.assert_allclose(columns("f_dc_0", "f_dc_1", "f_dc_2"), splats.sh[:, 0], rtol=1e-6)
    # Channel by channel, 15 coefficients each, of which those of degree 3 are 0.
    for c in range(3):
        rest = columns(*(f"f_rest_{15 * c + k}" for k in range(15)))
        np.testing.assert_allclose(rest[:, :8], splats.sh[:, 1:, c], rtol=1e-6)
        assert not rest[:, 8:].any()


def test_no_splats_are_refused(tmp_path):
    empty = np.zeros((0, 3))
    with pytest.raises(InputError, match="no splats"):
        write_splats(Splats(empty, np.zeros((0, 3, 3)), empty, np.zeros(0), np.zeros((0, 9, 3))), tmp_path / "a.ply")
