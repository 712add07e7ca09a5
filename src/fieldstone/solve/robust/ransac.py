"""RANSAC as in the textbook: random minimal samples, adaptive stopping, re-estimation from the inliers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

TRIALS_PER_BATCH = 64


@runtime_checkable
class Estimator(Protocol):
    """What RANSAC needs to know of a model; models are arrays, stacked along the first axis."""

    @property
    def sample_size(self) -> int:
        """Data in a minimal sample."""
        ...

    @property
    def num_data(self) -> int:
        """Data in all."""
        ...

    def fit_minimal(self, samples: Int[np.ndarray, "k s"]) -> Float[np.ndarray, "m a b"]:
        """Models of k samples, all together; nan where a sample has none."""
        ...

    def squared_errors(self, models: Float[np.ndarray, "m a b"]) -> Float[np.ndarray, "m n"]:
        """Squared error in pixels of every datum under every model; inf or nan where it cannot be."""
        ...

    def refit(self, inliers: Int[np.ndarray, "i"]) -> Float[np.ndarray, "1 a b"]:
        """The model of all these data, in the least-squares sense."""
        ...


@dataclass(frozen=True)
class RansacOptions:
    """When a datum is an inlier, and when to stop."""

    max_error_px: float = 2.0
    """Inlier threshold in pixels."""
    confidence: float = 0.9999
    """Stop once an all-inlier sample was drawn with this probability."""
    min_trials: int = 64
    """Samples drawn at least."""
    max_trials: int = 20_000
    """Samples drawn at most."""
    max_refits: int = 10
    """Re-estimations from the inliers; they end as soon as the score gets no better."""

    def __post_init__(self) -> None:
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie in (0, 1), got {self.confidence}")
        if not self.max_error_px > 0:
            raise ValueError(f"max_error_px must be positive, got {self.max_error_px}")
        if not 0 < self.min_trials <= self.max_trials:
            raise ValueError(f"need 0 < min_trials <= max_trials, got {self.min_trials}, {self.max_trials}")


@dataclass(frozen=True, eq=False)
class RansacResult:
    """The best model, its inliers and the number of samples drawn."""

    model: Float[np.ndarray, "a b"]
    inliers: Bool[np.ndarray, "n"]
    num_trials: int


def ransac(estimator: Estimator, options: RansacOptions, rng: np.random.Generator) -> RansacResult | None:
    """The model with the best truncated squared error over all data, re-estimated from its inliers.

    A model's score is sum min(error^2, threshold^2) (MSAC): inliers count by how well they fit. Samples are drawn
    in batches, and drawing stops as soon as the best inlier ratio w so far gives 1 - (1 - w^s)^trials > confidence.

    Returns:
        None if there are fewer data than a sample needs, or no sample gives a model with a sample's worth of inliers.

    Source:
        `fischler1981`; adaptive stopping `hartley2004`, algorithm 4.5; score `torr2000`.
    """
    n, size = estimator.num_data, estimator.sample_size
    if n < size:
        return None
    threshold2 = options.max_error_px**2
    best_score, best_model, best_inliers = np.inf, None, np.zeros(n, dtype=bool)
    trials, needed = 0, options.max_trials
    while trials < max(needed, options.min_trials) and trials < options.max_trials:
        batch = min(TRIALS_PER_BATCH, options.max_trials - trials)
        models = estimator.fit_minimal(draw_samples(n, size, batch, rng))
        trials += batch
        score, model, inliers = _best_of(estimator, models, threshold2)
        if score < best_score and inliers.sum() >= size:
            best_score, best_model, best_inliers = score, model, inliers
            needed = trials_needed(float(best_inliers.mean()), size, options.confidence)
    if best_model is None:
        return None
    for _ in range(options.max_refits):
        score, model, inliers = _best_of(estimator, estimator.refit(np.flatnonzero(best_inliers)), threshold2)
        if not score < best_score:
            break
        best_score, best_model, best_inliers = score, model, inliers
    return RansacResult(best_model, best_inliers, trials)


def trials_needed(inlier_ratio: float, sample_size: int, confidence: float) -> int:
    """Samples after which one without outliers was drawn with the given confidence.

    Source:
        `hartley2004`, eq. 4.18.
    """
    good = inlier_ratio**sample_size
    if good >= 1.0:
        return 1
    if good < 1e-12:
        return 2**62
    return int(np.ceil(np.log1p(-confidence) / np.log1p(-good)))


def draw_samples(n: int, size: int, count: int, rng: np.random.Generator) -> Int[np.ndarray, "count size"]:
    """Samples of `size` different indices below n, each uniformly.

    Floyd's method for all samples at once: no array of length n is touched.
    """
    out = np.empty((count, size), dtype=np.int64)
    for k, top in enumerate(range(n - size, n)):
        drawn = rng.integers(0, top + 1, size=count)
        taken = np.any(out[:, :k] == drawn[:, None], axis=1)
        out[:, k] = np.where(taken, top, drawn)
    return out


def _best_of(
    estimator: Estimator, models: Float[np.ndarray, "m a b"], threshold2: float
) -> tuple[float, Float[np.ndarray, "a b"], Bool[np.ndarray, "n"]]:
    """Score, model and inliers of the best of several models."""
    errors2 = np.nan_to_num(estimator.squared_errors(models), nan=np.inf)
    scores = np.minimum(errors2, threshold2).sum(axis=1)
    best = int(np.argmin(scores))
    return float(scores[best]), models[best], errors2[best] <= threshold2
