"""Point clouds: exact round trips, every encoding written by hand, a real mesh, damage."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.io.shapes.ply import read_points, write_points
from fieldstone.scene.reconstruction import Points
from mutations import check_mutations
from real_data import data_folder

XYZ = [(1.5, -2.0, 3.25), (0.1, 1e10, -7.0)]
RGB = [(255, 0, 7), (1, 2, 3)]


def random_points(count: int) -> Points:
    rng = np.random.default_rng(0)
    return Points(rng.normal(size=(count, 3)) * 1e6, rng.integers(0, 256, size=(count, 3), dtype=np.uint8))


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_round_trip_is_exact(tmp_path, count):
    points = random_points(count)
    write_points(points, tmp_path / "p.ply")
    read = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(read.xyz, points.xyz)
    np.testing.assert_array_equal(read.rgb, points.rgb)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("order", ["<", ">", "ascii"])
@pytest.mark.parametrize("names", [("uchar", "double", "int"), ("uint8", "float64", "int32")])
def test_encodings_with_extra_elements_and_properties(tmp_path, order, newline, names):
    byte, real, whole = names
    encoding = {"<": "binary_little_endian", ">": "binary_big_endian", "ascii": "ascii"}[order]
    header = f"""ply
format {encoding} 1.0
comment made by hand
obj_info none
element camera 1
property {real} fov
element strip 2
property list {byte} {whole} indices
element vertex 2
property {real} nx
property {byte} red
property {byte} green
property {byte} blue
property list {byte} {byte} flags
property {real} z
property {real} y
property {real} x
element face 1
property list {byte} {whole} vertex_indices
end_header
"""
    if order == "ascii":
        lines = ["0.5", "2 7 8", "0"]
        lines += [f"9 {r} {g} {b} 2 1 1 {z!r} {y!r} {x!r}" for (x, y, z), (r, g, b) in zip(XYZ, RGB, strict=True)]
        body = "".join(line + newline for line in [*lines, "3 0 1 1"]).encode()
    else:
        body = struct.pack(f"{order}dB2iB", 0.5, 2, 7, 8, 0)
        for (x, y, z), rgb in zip(XYZ, RGB, strict=True):
            body += struct.pack(f"{order}d3B3B3d", 9.0, *rgb, 2, 1, 1, z, y, x)
        body += struct.pack(f"{order}B3i", 3, 0, 1, 1)
    (tmp_path / "p.ply").write_bytes(header.replace("\n", newline).encode() + body)
    points = read_points(tmp_path / "p.ply")
    np.testing.assert_array_equal(points.xyz, XYZ)
    np.testing.assert_array_equal(points.rgb, RGB)


@pytest.mark.parametrize(
    ("properties", "values", "expected"),
    [
        (["float red", "float green", "float blue"], "1 0 0.5", (255, 0, 128)),
        (["ushort red", "ushort green", "ushort blue"], "65535 0 258", (255, 0, 1)),
        (["uchar diffuse_red", "uchar diffuse_green", "uchar diffuse_blue"], "1 2 3", (1, 2, 3)),
        (["uchar red"], "9", (128, 128, 128)),
    ],
)
def test_colours_of_other_kinds(tmp_path, properties, values, expected):
    head = ["ply", "format ascii 1.0", "element vertex 1", *(f"property float {a}" for a in "xyz")]
    text = "\n".join([*head, *(f"property {p}" for p in properties), "end_header", f"1 2 3 {values}", ""])
    (tmp_path / "p.ply").write_text(text)
    np.testing.assert_array_equal(read_points(tmp_path / "p.ply").rgb, [expected])


HEADER = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plx\n", "the first line must be `ply`"),
        ("ply\nformat ascii 1.0\n", "the header does not end"),
        ("ply\nend_header\n", "line 2: the header has no format"),
        ("ply\nformat middle_endian 1.0\nend_header\n", "line 2: .*unknown format"),
        ("ply\nformat ascii 1.0\nelement vertex -3\n", "line 3: .*'-3' is not a number"),
        ("ply\nformat ascii 1.0\nproperty float x\n", "line 3: damaged header"),
        (HEADER.replace("float y", "half y"), "line 5: damaged header"),
        (HEADER.replace("float y", "float x"), "line 5: .*'x' is there twice"),
        (HEADER.replace("float z", "float w") + "1 2 3\n4 5 6\n", "vertices have no z"),
        (HEADER.replace("vertex", "point") + "1 2 3\n4 5 6\n", "no vertex element; it holds point"),
        (HEADER + "1 2 3\n", "truncated"),
        (HEADER + "1 2 3\n4 5 six\n", "record 1 of 'vertex'"),
        (HEADER + "1 2 3 4\n5 6 7\n", "record 0 of 'vertex'.*4 values instead of 3"),
        (HEADER + "1 2 3\n4 nan 6\n", "vertex 1 is not finite"),
        (HEADER.replace("vertex 2", "vertex 999999999999999999"), "do not fit into the 0 bytes"),
        (HEADER.replace("ascii", "binary_little_endian") + "123456789", r"byte 115: 2 records .* truncated"),
    ],
)
def test_wrong_files_say_where_and_why(tmp_path, text, message):
    (tmp_path / "p.ply").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_points(tmp_path / "p.ply")
    assert "p.ply" in str(caught.value)


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path / "p.ply")


@pytest.mark.parametrize("ascii_text", [True, False])
def test_damaged_files_end_in_an_input_error_or_in_points(tmp_path, ascii_text):
    path = tmp_path / "p.ply"
    write_points(random_points(20), path)
    if ascii_text:
        header = HEADER.replace("2", "20").encode()
        path.write_bytes(header + b"".join(b"%.6f %.6f %.6f\n" % tuple(p) for p in random_points(20).xyz))
    assert len(read_points(path)) == 20
    loaded, refused = check_mutations(path, lambda: read_points(path), lambda p: np.isfinite(p.xyz).all(), count=400)
    assert min(loaded, refused) > 10


def test_vertices_of_a_real_mesh():
    (path,) = data_folder("astrovision").rglob("vesta_5002.ply")
    points = read_points(path)
    assert points.xyz.shape == (5002, 3)
    # The asteroid Vesta: 573 x 557 x 446 km.
    np.testing.assert_allclose(np.sort(np.ptp(points.xyz, axis=0)), [446, 557, 573], rtol=0.05)
