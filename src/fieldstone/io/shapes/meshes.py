"""Meshes to files: PLY, OBJ and GLB, chosen by the suffix."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import write_bytes
from fieldstone.scene.mesh import Mesh

MESH_SUFFIXES = (".ply", ".obj", ".glb")

GLB_MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


def write_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh, whole or not at all.

    PLY: binary, sRGB. OBJ: text, colours in [0, 1] behind the coordinates, which most programs read. GLB: binary glTF
    2.0, whose world has y up and whose vertex colours are linear.

    Raises:
        InputError: No such format, or an empty mesh.
    """
    if not len(mesh.faces):
        raise InputError(f"{path}: the mesh has no faces; train the field longer or ask for a lower `level`")
    writers = {".ply": _ply, ".obj": _obj, ".glb": _glb}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path}: a mesh can be written as {', '.join(MESH_SUFFIXES)}")
    write_bytes(path, writer(mesh))


def _ply(mesh: Mesh) -> bytes:
    colored = mesh.colors is not None
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [("xyz", "<f4", (3,))]
    if colored:
        header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
        fields.append(("rgb", "u1", (3,)))
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    vertices = np.zeros(len(mesh.vertices), dtype=fields)
    vertices["xyz"] = mesh.vertices
    if mesh.colors is not None:
        vertices["rgb"] = mesh.colors
    faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", (3,))])
    faces["count"], faces["index"] = 3, mesh.faces
    return "\n".join([*header, ""]).encode() + vertices.tobytes() + faces.tobytes()


def _obj(mesh: Mesh) -> bytes:
    lines = ["# x y z r g b" if mesh.colors is not None else "# x y z"]
    if mesh.colors is None:
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.vertices.tolist()]
    else:
        rows = np.column_stack([mesh.vertices, mesh.colors / 255.0]).tolist()
        lines += [f"v {x:.7g} {y:.7g} {z:.7g} {r:.4f} {g:.4f} {b:.4f}" for x, y, z, r, g, b in rows]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join([*lines, ""]).encode()


def _glb(mesh: Mesh) -> bytes:
    positions = mesh.vertices.astype("<f4")
    parts: list[tuple[bytes, int]] = [
        (positions.tobytes(), ARRAY_BUFFER),
        (mesh.vertex_normals().astype("<f4").tobytes(), ARRAY_BUFFER),
        (mesh.faces.astype("<u4").tobytes(), ELEMENT_ARRAY_BUFFER),
    ]
    count = len(positions)
    accessors = [
        {"bufferView": 0, "componentType": FLOAT, "count": count, "type": "VEC3",
         "min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()},
        {"bufferView": 1, "componentType": FLOAT, "count": count, "type": "VEC3"},
        {"bufferView": 2, "componentType": UNSIGNED_INT, "count": 3 * len(mesh.faces), "type": "SCALAR"},
    ]  # fmt: skip
    attributes = {"POSITION": 0, "NORMAL": 1}
    if mesh.colors is not None:
        parts.append((linear_rgba(mesh.colors).tobytes(), ARRAY_BUFFER))
        color = {"bufferView": 3, "componentType": UNSIGNED_SHORT, "count": count, "type": "VEC4", "normalized": True}
        accessors.append(color)
        attributes["COLOR_0"] = 3
    views, buffer = [], b""
    for data, target in parts:
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data), "target": target})
        buffer += data + b"\0" * (-len(data) % 4)
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
    content = {
        "asset": {"version": "2.0", "generator": "fieldstone"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 2, "material": 0}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(buffer)
    header = struct.pack("<III", GLB_MAGIC, 2, total)
    return b"".join(
        [header, struct.pack("<II", len(text), JSON_CHUNK), text, struct.pack("<II", len(buffer), BINARY_CHUNK), buffer]
    )


def linear_rgba(srgb: UInt8[np.ndarray, "v 3"]) -> UInt16[np.ndarray, "v 4"]:
    """Linear light in 16 bits, opaque: 8 bits would show steps in the dark.

    Source:
        `iec61966`: c / 12.92 up to 0.04045, ((c + 0.055) / 1.055)^2.4 above.
    """
    c: Float[np.ndarray, "v 3"] = srgb / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return np.column_stack([np.rint(65535.0 * linear), np.full(len(c), 65535.0)]).astype("<u2")
