"""Gaussian splats to PLY, as programs for 3D Gaussian splatting read it.

Binary, little-endian, 62 floats a splat, because some readers take no fewer: position, normal, colour coefficients up
to degree 3 (channel by channel behind the first ones), the logit of the opacity, logarithms of the scales, and the
rotation w x y z. The world is that of the cameras, usually with y down.

Source:
    `kerbl2023`, the files of its reference program.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from fieldstone.errors import InputError
from fieldstone.geometry.rotation import to_wxyz
from fieldstone.io.files.atomic import write_bytes
from fieldstone.scene.splats import NUM_SH, Splats

NUM_REST = 45
"""Colour coefficients of degree 1 to 3."""

MAX_OPACITY = 0.9999
"""Logits end here."""

PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{k}" for k in range(NUM_REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_splats(splats: Splats, path: Path) -> None:
    """Write splats in the world as PLY with the properties of the original program, whole or not at all.

    Raises:
        InputError: There are none.
    """
    if not len(splats):
        raise InputError(f"{path}: there are no splats; train the field longer or ask for a lower `level`")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}"]
    header += [*(f"property float {name}" for name in PROPERTIES), "end_header", ""]
    write_bytes(path, "\n".join(header).encode() + _rows(splats).tobytes())


def _rows(splats: Splats) -> Float[np.ndarray, "n 62"]:
    """All properties of each splat, in the order of `PROPERTIES`."""
    rest = np.zeros((len(splats), 3, NUM_REST // 3))
    rest[:, :, : NUM_SH - 1] = np.swapaxes(splats.sh[:, 1:], 1, 2)
    opacity = np.clip(splats.opacities, 1.0 - MAX_OPACITY, MAX_OPACITY)
    rows = np.column_stack(
        [
            splats.means, splats.axes[:, :, 2], splats.sh[:, 0], rest.reshape(len(splats), -1),
            np.log(opacity / (1.0 - opacity)), np.log(splats.scales), to_wxyz(splats.axes),
        ]
    )  # fmt: skip
    return np.ascontiguousarray(rows, dtype="<f4")
