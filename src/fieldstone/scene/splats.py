"""Gaussian splats: a surface as many small flat clouds, each with a colour that depends on where it is seen from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

SH_C0 = 0.28209479177387814
SH_DEGREE = 2
NUM_SH = (SH_DEGREE + 1) ** 2


@dataclass(frozen=True, eq=False)
class Splats:
    """Density of splat i at x: opacity exp(-|S^-1 R^T (x - mean)|^2 / 2), R its axes and S its scales."""

    means: Float[np.ndarray, "n 3"]
    axes: Float[np.ndarray, "n 3 3"]
    """World from own axes; a rotation."""
    scales: Float[np.ndarray, "n 3"]
    """Standard deviation along each own axis."""
    opacities: Float[np.ndarray, "n"]
    sh: Float[np.ndarray, "n 9 3"]
    """Coefficients of `sh_basis`; a colour is 0.5 + their sum, cut at 0."""

    def __len__(self) -> int:
        return len(self.means)


def sh_basis(directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 9"]:
    """Real spherical harmonics of degree 0 to 2 of unit directions from the camera to the splat.

    Source:
        `kerbl2023`: order and signs are those of its files.
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    c1, c2 = 0.4886025119029199, 1.0925484305920792
    return np.stack(
        [
            np.full(x.shape, SH_C0), -c1 * y, c1 * z, -c1 * x, c2 * x * y, -c2 * y * z,
            0.31539156525252005 * (2.0 * z * z - x * x - y * y), -c2 * x * z, 0.5 * c2 * (x * x - y * y),
        ],
        axis=-1,
    )  # fmt: skip


def splat_colors(splats: Splats, eye: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Colours of all splats as a camera at `eye` sees them, sRGB in [0, ...)."""
    ahead = splats.means - eye
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", sh_basis(ahead), splats.sh), 0.0)
