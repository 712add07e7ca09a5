"""Flat textured patches and what a camera sees of them: the ray caster of the synthetic photos.

A patch is a parallelogram origin + a edge_a + b edge_b with a in [0, size_a], b in [0, size_b] (metres, unit edges),
less what lies outside its half-planes, inside its holes or where its mask is off. For a camera, the ray through the
point (x, y) of the plane z = 1 meets the patch at

    (a, b, 1) / depth = inv([R edge_a, R edge_b, R origin + t]) (x, y, 1),

so that a / depth, b / depth and 1 / depth are affine in (x, y): one matrix per patch and view answers every pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.geometry.rigid3 import Rigid3

NEAR = 0.05
"""Nothing closer to the camera than this is drawn, in metres."""


@dataclass(frozen=True, eq=False)
class Patch:
    """One flat piece of surface; `cross(edge_a, edge_b)` points out of the solid."""

    origin: Float[np.ndarray, "3"]
    edge_a: Float[np.ndarray, "3"]
    edge_b: Float[np.ndarray, "3"]
    size_a: float
    size_b: float
    half_planes: Float[np.ndarray, "k 3"]
    """Rows (p, q, r): only where p a + q b <= r."""
    holes: Float[np.ndarray, "h 4"]
    """Rows (a0, b0, a1, b1) that are open."""
    mask: Bool[np.ndarray, "mh mw"] | None = None
    """Outline of leaves and the like, stretched over the patch; row 0 at b = 0."""

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit vector out of the solid."""
        return np.cross(self.edge_a, self.edge_b)

    def points(self, a: Float[np.ndarray, "*n"], b: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n 3"]:
        """World points at patch coordinates."""
        return self.origin + a[..., None] * self.edge_a + b[..., None] * self.edge_b

    def corners(self) -> Float[np.ndarray, "4 3"]:
        """World points of the parallelogram's corners."""
        a, b = np.array([0.0, self.size_a, self.size_a, 0.0]), np.array([0.0, 0.0, self.size_b, self.size_b])
        return self.points(a, b)

    def contains(self, a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        """Whether the patch is solid at coordinates that lie in the parallelogram."""
        inside = np.ones(len(a), dtype=bool)
        for p, q, r in self.half_planes:
            inside &= p * a + q * b <= r
        for a0, b0, a1, b1 in self.holes:
            inside &= ~((a > a0) & (a < a1) & (b > b0) & (b < b1))
        if self.mask is not None:
            rows, cols = self.mask.shape
            i = np.clip((b * (rows / self.size_b)).astype(np.int64), 0, rows - 1)
            j = np.clip((a * (cols / self.size_a)).astype(np.int64), 0, cols - 1)
            inside &= self.mask[i, j]
        return inside


def planes_from_view(patches: Sequence[Patch], cam_from_world: Rigid3) -> Float[np.ndarray, "p 3 3"]:
    """The matrix of the module's equation for every patch; 0 for a patch seen exactly edge on."""
    columns = np.array([(p.edge_a, p.edge_b, p.origin) for p in patches])
    M = np.swapaxes(columns @ cam_from_world.R.T, 1, 2)
    M[:, :, 2] += cam_from_world.t
    proper = np.abs(np.linalg.det(M)) > 1e-9
    out = np.zeros_like(M)
    out[proper] = np.linalg.inv(M[proper])
    return out


@dataclass(frozen=True, eq=False)
class Seen:
    """What each sample of a view sees: the patch (-1: sky) and the depth along z (inf: sky)."""

    patch: Int[np.ndarray, "h w"]
    depth: Float[np.ndarray, "h w"]


def look(
    patches: Sequence[Patch], cam_from_world: Rigid3, x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"]
) -> Seen:
    """The nearest patch along the ray through each point (x, y) of the plane z = 1.

    x must grow along the rows and y down the columns, as they do for the pixels of any photo.
    """
    inverse_depth = np.zeros(x.shape)
    seen = np.full(x.shape, -1, dtype=np.int32)
    planes = planes_from_view(patches, cam_from_world)
    windows = _windows(cam_from_world.apply(np.array([p.corners() for p in patches])), x, y)
    for index, (patch, N) in enumerate(zip(patches, planes, strict=True)):
        top, bottom, left, right = windows[index]
        if bottom <= top or right <= left:
            continue
        window = slice(top, bottom), slice(left, right)
        u, v, nearest = x[window], y[window], inverse_depth[window]
        w = N[2, 0] * u + N[2, 1] * v + N[2, 2]
        a = N[0, 0] * u + N[0, 1] * v + N[0, 2]
        b = N[1, 0] * u + N[1, 1] * v + N[1, 2]
        hit = (w > nearest) & (w < 1 / NEAR) & (a >= 0) & (b >= 0) & (a <= patch.size_a * w) & (b <= patch.size_b * w)
        where = np.flatnonzero(hit)
        if not len(where):
            continue
        at = w.ravel()[where]
        if len(patch.half_planes) or len(patch.holes) or patch.mask is not None:
            solid = patch.contains(a.ravel()[where] / at, b.ravel()[where] / at)
            where, at = where[solid], at[solid]
        i, j = np.unravel_index(where, hit.shape)
        nearest[i, j] = at
        seen[window][i, j] = index
    with np.errstate(divide="ignore"):
        return Seen(seen, 1.0 / inverse_depth)


def _windows(
    corners_in_cam: Float[np.ndarray, "p 4 3"], x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"]
) -> list[list[int]]:
    """Rows (top, bottom, left, right) of samples that each patch can cover; empty where it covers none."""
    z = corners_in_cam[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        px, py = corners_in_cam[..., 0] / z, corners_in_cam[..., 1] / z
    crossing = np.any(z < NEAR, axis=1)
    # A patch that reaches behind the camera can be anywhere; one that lies behind it wholly is nowhere.
    low = np.where(crossing[:, None], -np.inf, np.stack([px.min(axis=1), py.min(axis=1)], axis=1))
    high = np.where(crossing[:, None], np.inf, np.stack([px.max(axis=1), py.max(axis=1)], axis=1))
    high = np.where(np.all(z < NEAR, axis=1)[:, None], -np.inf, high)
    return np.stack(
        [
            np.searchsorted(y.max(axis=1), low[:, 1]),
            np.searchsorted(y.min(axis=1), high[:, 1], side="right"),
            np.searchsorted(x.max(axis=0), low[:, 0]),
            np.searchsorted(x.min(axis=0), high[:, 0], side="right"),
        ],
        axis=1,
    ).tolist()


@dataclass(frozen=True, eq=False)
class Texture:
    """Linear-light colours of a patch at falling resolution; level k has texels of size texel * 2^k."""

    levels: tuple[Float[np.ndarray, "_ _ c"], ...]
    texel: float

    @staticmethod
    def build(colors: Float[np.ndarray, "h w c"], texel: float) -> Texture:
        """The texture with all its coarser levels."""
        levels = [np.ascontiguousarray(colors, dtype=np.float32)]
        while min(levels[-1].shape[:2]) > 1:
            height, width = levels[-1].shape[:2]
            size = ((width + 1) // 2, (height + 1) // 2)
            coarser = cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA)
            levels.append(coarser.astype(np.float32).reshape(size[1], size[0], -1))
        return Texture(tuple(levels), texel)

    def sample(
        self, a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"], footprint: Float[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n c"]:
        """Colours at coordinates in metres, averaged over about `footprint` metres."""
        level = np.rint(np.log2(np.maximum(footprint / self.texel, 1.0))).astype(np.int64)
        level = np.minimum(level, len(self.levels) - 1)
        if level.min(initial=0) == level.max(initial=0):
            return self._bilinear(int(level.max(initial=0)), a, b)
        out = np.empty((len(a), self.levels[0].shape[2]), dtype=np.float32)
        for k in np.unique(level):
            rows = np.flatnonzero(level == k)
            out[rows] = self._bilinear(int(k), a[rows], b[rows])
        return out

    def _bilinear(self, k: int, a: Float[np.ndarray, "n"], b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n c"]:
        image = self.levels[k]
        height, width = image.shape[:2]
        # Coarser levels cover the same patch: their texels are stretched when the size was odd.
        scale_a = width / (self.levels[0].shape[1] * self.texel)
        scale_b = height / (self.levels[0].shape[0] * self.texel)
        u = np.minimum(np.maximum(a * scale_a - 0.5, 0.0), width - 1.0).astype(np.float32)
        v = np.minimum(np.maximum(b * scale_b - 0.5, 0.0), height - 1.0).astype(np.float32)
        i, j = v.astype(np.int32), u.astype(np.int32)
        fu, fv = (u - j)[:, None], (v - i)[:, None]
        right = np.minimum(j + 1, width - 1)
        upper, lower = i * width, np.minimum(i + 1, height - 1) * width
        flat = image.reshape(height * width, -1)
        top = flat[upper + j] * (1 - fu) + flat[upper + right] * fu
        bottom = flat[lower + j] * (1 - fu) + flat[lower + right] * fu
        return top * (1 - fv) + bottom * fv


def shade(
    patches: Sequence[Patch],
    textures: Sequence[Texture],
    tints: Float[np.ndarray, "p 3"],
    seen: Seen,
    cam_from_world: Rigid3,
    x: Float[np.ndarray, "h w"],
    y: Float[np.ndarray, "h w"],
    sample_angle: float,
) -> Float[np.ndarray, "h w 3"]:
    """Linear-light colour of every sample that sees a patch; 0 where it sees the sky.

    Args:
        tints: Factors on the colours of each patch's texture.
        sample_angle: Distance between two samples on the plane z = 1.
    """
    planes = planes_from_view(patches, cam_from_world)
    out = np.zeros((*x.shape, 3), dtype=np.float32)
    flat, colors = seen.patch.ravel(), out.reshape(-1, 3)
    order = np.argsort(flat, kind="stable")
    start = np.searchsorted(flat[order], np.arange(len(patches) + 1))
    x, y = x.ravel(), y.ravel()
    for index in np.flatnonzero(np.diff(start)).tolist():
        where = order[start[index] : start[index + 1]]
        N = planes[index]
        u, v = x[where], y[where]
        w = N[2, 0] * u + N[2, 1] * v + N[2, 2]
        a = (N[0, 0] * u + N[0, 1] * v + N[0, 2]) / w
        b = (N[1, 0] * u + N[1, 1] * v + N[1, 2]) / w
        # |d(a, b) / d(x, y)| = |det N| / w^3: the area on the patch that one sample stands for.
        footprint = sample_angle * np.sqrt(abs(np.linalg.det(N)) / w**3)
        colors[where] = textures[index].sample(a, b, footprint) * tints[index]
    return out
