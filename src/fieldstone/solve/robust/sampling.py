"""What robust estimators decide outside of their compiled loop: the samples, and the scale of the last refinement."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from fieldstone.solve.robust.consensus_numba import Sampling
from fieldstone.solve.robust.ransac import RansacOptions

SIGMA_PER_MEDIAN = 1.4826


def sampling_of(
    options: RansacOptions,
    rng: np.random.Generator,
    pool: Int[np.ndarray, "p"],
    local_steps: int,
    *,
    progressive: bool = False,
) -> Sampling:
    """Samples from a pool as the options say; the seed of the kernel's own generator is the next draw of `rng`."""
    return Sampling(
        pool=pool,
        progressive=progressive,
        confidence=float(options.confidence),
        min_trials=int(options.min_trials),
        max_trials=int(options.max_trials),
        local_steps=local_steps,
        seed=np.uint64(rng.integers(0, 2**63)),
    )


def soft_scale(squared_errors: Float[np.ndarray, "n"], max_error_px: float, per_sigma: float, limit: float) -> float:
    """Scale in pixels of the Geman-McClure loss: `per_sigma` times the noise of the inliers, at most `limit`.

    The noise is taken from the median error of the inliers, which a threshold that is wider than the noise does not
    change much.
    """
    inliers = squared_errors[squared_errors < max_error_px**2]
    sigma = SIGMA_PER_MEDIAN * float(np.sqrt(np.median(inliers))) if len(inliers) else max_error_px
    return min(max(per_sigma * sigma, 1e-3 * max_error_px), limit)
