"""Meshes to files: read back by the definition of each format."""

import json
import struct

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.io.shapes.meshes import linear_rgba, write_mesh
from fieldstone.io.shapes.ply import read_points
from fieldstone.scene.mesh import Mesh

TETRAHEDRON = Mesh(
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    np.array([[0, 0, 0], [255, 128, 10], [3, 200, 255], [255, 255, 255]], dtype=np.uint8),
)


def test_the_tetrahedron_is_closed():
    assert TETRAHEDRON.is_closed()
    assert TETRAHEDRON.volume() == pytest.approx(1.5 / 6)
    assert not Mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[:3]).is_closed()


def test_ply_holds_vertices_colors_and_faces(tmp_path):
    path = tmp_path / "mesh.ply"
    write_mesh(TETRAHEDRON, path)
    points = read_points(path)
    np.testing.assert_allclose(points.xyz, TETRAHEDRON.vertices)
    np.testing.assert_array_equal(points.rgb, TETRAHEDRON.colors)
    body = path.read_bytes().split(b"end_header\n", 1)[1][4 * 15 :]
    faces = [struct.unpack_from("<B3i", body, 13 * k) for k in range(4)]
    assert len(body) == 4 * 13
    assert [list(face[1:]) for face in faces] == TETRAHEDRON.faces.tolist()
    assert all(face[0] == 3 for face in faces)


def test_obj_holds_vertices_colors_and_faces(tmp_path):
    path = tmp_path / "mesh.obj"
    write_mesh(TETRAHEDRON, path)
    lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    rows = np.array([[float(word) for word in line[1:]] for line in lines if line[0] == "v"])
    assert TETRAHEDRON.colors is not None
    np.testing.assert_allclose(rows[:, :3], TETRAHEDRON.vertices)
    np.testing.assert_allclose(rows[:, 3:] * 255, TETRAHEDRON.colors, atol=0.05)
    faces = [[int(word) - 1 for word in line[1:]] for line in lines if line[0] == "f"]
    assert faces == TETRAHEDRON.faces.tolist()


def test_glb_is_what_the_specification_says(tmp_path):
    path = tmp_path / "mesh.glb"
    write_mesh(TETRAHEDRON, path)
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_length, text_kind = struct.unpack_from("<I4s", data, 12)
    assert text_kind == b"JSON"
    assert text_length % 4 == 0
    content = json.loads(data[20 : 20 + text_length])
    binary_length, binary_kind = struct.unpack_from("<I4s", data, 20 + text_length)
    assert binary_kind == b"BIN\0"
    buffer = data[28 + text_length :]
    assert len(buffer) == binary_length == content["buffers"][0]["byteLength"]

    def array(accessor, dtype, columns):
        described = content["accessors"][accessor]
        view = content["bufferViews"][described["bufferView"]]
        part = buffer[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        return np.frombuffer(part, dtype).reshape(-1, columns)

    primitive = content["meshes"][0]["primitives"][0]
    positions = array(primitive["attributes"]["POSITION"], "<f4", 3)
    np.testing.assert_allclose(positions, TETRAHEDRON.vertices)
    described = content["accessors"][primitive["attributes"]["POSITION"]]
    assert (described["min"], described["max"]) == ([0, 0, 0], [1, 1, 1.5])
    np.testing.assert_array_equal(array(primitive["indices"], "<u4", 3), TETRAHEDRON.faces)
    assert TETRAHEDRON.colors is not None
    colors = array(primitive["attributes"]["COLOR_0"], "<u2", 4)
    np.testing.assert_array_equal(colors, linear_rgba(TETRAHEDRON.colors))


def test_linear_colors_invert_srgb():
    """Black, white, and the closed form backwards: c = 1.055 l^(1 / 2.4) - 0.055."""
    rgb = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    linear = linear_rgba(rgb)[:, 0] / 65535.0
    back = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(255 * back, rgb[:, 0], atol=0.05)


@pytest.mark.parametrize(
    ("mesh", "name", "message"),
    [
        (TETRAHEDRON, "mesh.stl", "ply"),
        (Mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[:0]), "mesh.ply", "no faces"),
    ],
)
def test_mistakes_are_named(tmp_path, mesh, name, message):
    with pytest.raises(InputError, match=message):
        write_mesh(mesh, tmp_path / name)
