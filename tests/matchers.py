"""Shared assertions: poses, reconstructions up to a similarity, Jacobians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between
from fieldstone.scene.alignment import align
from fieldstone.scene.reconstruction import Reconstruction


def assert_rigid3_near(actual: Rigid3, expected: Rigid3, *, angle: float = 1e-6, distance: float = 1e-6) -> None:
    """Rotation within `angle` radians and translation within `distance` units, for every pose of a batch."""
    assert actual.R.shape == expected.R.shape, f"{actual.R.shape} != {expected.R.shape}"
    angles = np.atleast_1d(angle_between(actual.R, expected.R))
    distances = np.atleast_1d(np.linalg.norm(actual.t - expected.t, axis=-1))
    assert np.all(angles <= angle), f"rotation off by {angles.max():.3g} rad (allowed {angle:.3g})"
    assert np.all(distances <= distance), f"translation off by {distances.max():.3g} (allowed {distance:.3g})"


def assert_reconstruction_near(
    actual: Reconstruction,
    expected: Reconstruction,
    *,
    angle_deg: float,
    relative_distance: float,
) -> None:
    """All views of `expected` registered, and poses equal up to a Sim3.

    relative_distance: allowed position error, as a share of the extent of the expected camera centres.
    """
    missing = {expected.views[i].name for i in expected.registered().tolist()} - {
        actual.views[i].name for i in actual.registered().tolist()
    }
    assert not missing, f"not registered: {sorted(missing)}"
    comparison = align(actual, expected)
    extent = float(np.linalg.norm(np.ptp(expected.camera_centers(), axis=0)))
    worst_deg = float(np.rad2deg(comparison.rotation_error.max()))
    worst_distance = float(comparison.position_error.max()) / extent
    assert worst_deg <= angle_deg, f"rotation off by {worst_deg:.3g} deg (allowed {angle_deg:.3g})"
    assert worst_distance <= relative_distance, (
        f"position off by {worst_distance:.3g} (allowed {relative_distance:.3g})"
    )


def assert_draws(errors: list[float], *, below: float, fraction: float = 1.0) -> None:
    """At least this fraction of seeded draws has an error below the limit; the message names those that have not."""
    found = np.asarray(errors, dtype=np.float64)
    bad = np.flatnonzero(~(found < below))
    allowed = int(np.floor((1.0 - fraction) * len(found) + 1e-9))
    assert len(found), "no draw at all"
    worst = ", ".join(f"draw {k}: {found[k]:.3g}" for k in bad[:10])
    assert len(bad) <= allowed, f"{len(bad)} of {len(found)} draws not below {below:g} (allowed {allowed}): {worst}"


def check_jacobian(
    value: Callable[[np.ndarray], np.ndarray],
    jacobian: np.ndarray,
    *,
    size: int,
    step: float = 1e-6,
    rtol: float = 1e-6,
) -> None:
    """`jacobian` equals the central difference of `value(delta)` at delta = 0, relative to its largest entry.

    `value` takes a tangent vector of length `size` (apply it with the retraction) and returns any array; the last
    axis of `jacobian` is the tangent.
    """
    numeric = np.stack(
        [(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(size)],
        axis=-1,
    )
    assert jacobian.shape == numeric.shape, f"{jacobian.shape} != {numeric.shape}"
    assert np.all(np.isfinite(jacobian))
    scale = max(float(np.abs(numeric).max(initial=0.0)), 1e-12)
    worst = float(np.abs(jacobian - numeric).max(initial=0.0)) / scale
    assert worst <= rtol, f"Jacobian off by {worst:.3g} relative (allowed {rtol:.3g})"
