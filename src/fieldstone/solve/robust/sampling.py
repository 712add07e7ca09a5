"""What every robust estimator decides outside of its compiled loop: the seed, and the scale of the last refinement."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SIGMA_PER_MEDIAN = 1.4826


def kernel_seed(rng: np.random.Generator) -> np.uint64:
    """Seed of a kernel's own generator, the next draw of `rng`."""
    return np.uint64(rng.integers(0, 2**63))


def soft_scale(squared_errors: Float[np.ndarray, "n"], max_error_px: float, per_sigma: float, limit: float) -> float:
    """Scale in pixels of the Geman-McClure loss: `per_sigma` times the noise of the inliers, at most `limit`.

    The noise is taken from the median error of the inliers, which a threshold that is wider than the noise does not
    change much.
    """
    inliers = squared_errors[squared_errors < max_error_px**2]
    sigma = SIGMA_PER_MEDIAN * float(np.sqrt(np.median(inliers))) if len(inliers) else max_error_px
    return min(max(per_sigma * sigma, 1e-3 * max_error_px), limit)
