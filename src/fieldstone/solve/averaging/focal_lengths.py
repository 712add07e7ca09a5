"""Focal lengths of many photos at once, from the fundamental matrices of pairs among them.

A fundamental matrix and two focal lengths give K2^T F K1, which is essential if and only if its two singular values
are equal: two equations for two unknowns. One pair solves them badly or, when the optical axes meet, not at all; many
pairs together do, if each counts as much as it knows and false ones do not count.

All focal lengths are logarithms of the focal length over the unit of the photo's coordinates (its longer side).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import expit

TRUST = 5.0
"""Logarithm of how much more likely a pair's F is, if it is of the focal lengths, than if it is of a false pair."""
SMALLEST_RESIDUAL_SIGMA = 0.005
"""No pair is known to be essential better than this: lenses are not pinholes."""
STATED_SIGMA, STATED_TRUST = 0.05, 3.0
"""A focal length that is stated (by EXIF) is off by about this share, or says nothing: the odds, as a logarithm."""
COARSE_SIGMA = 0.05
"""The same for a first round, which sees further."""
GRID = np.linspace(np.log(0.2), np.log(8.0), 100)
"""Where one offset of all unknown focal lengths is looked for."""
MAX_STARTS = 3
ITERATIONS, TOLERANCE, LARGEST_STEP, LARGEST_DAMPING = 30, 1e-3, 0.5, 1e3


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """Fundamental matrices of pairs of photos, in coordinates with the principal point as origin."""

    pairs: Int[np.ndarray, "p 2"]
    fundamentals: Float[np.ndarray, "p 3 3"]
    """Rank 2."""
    covariances: Float[np.ndarray, "p 9 9"]
    """Of their entries, row by row."""


@dataclass(frozen=True, eq=False)
class FocalPrior:
    """What is known of each group's focal length: its logarithm is about `mean`, give or take `sigma`.

    `stated` is what somebody says of it, within `STATED_SIGMA`, who may be wrong altogether; nan where nobody does.
    """

    mean: Float[np.ndarray, "g"]
    sigma: Float[np.ndarray, "g"]
    stated: Float[np.ndarray, "g"]

    def of(self, groups: Int[np.ndarray, "h"]) -> FocalPrior:
        """That of some groups."""
        return FocalPrior(self.mean[groups], self.sigma[groups], self.stated[groups])

    def log_density(self, log_focal: Float[np.ndarray, "g"]) -> float:
        """Of all groups, up to a constant."""
        known = -0.5 * ((log_focal - self.mean) / self.sigma) ** 2
        stated = np.logaddexp(0.0, STATED_TRUST - 0.5 * self._off(log_focal) ** 2)
        return float(np.sum(known) + np.sum(np.where(np.isnan(self.stated), 0.0, stated)))

    def derivatives(self, log_focal: Float[np.ndarray, "g"]) -> tuple[Float[np.ndarray, "g"], Float[np.ndarray, "g"]]:
        """Of `log_density`: first, and the negative second ones (what is stated weighs as much as it is believed)."""
        off = self._off(log_focal)
        weight = self.belief(log_focal) / STATED_SIGMA**2
        first = (self.mean - log_focal) / self.sigma**2 - weight * off * STATED_SIGMA
        return first, self.sigma**-2.0 + weight

    def belief(self, log_focal: Float[np.ndarray, "g"]) -> Float[np.ndarray, "g"]:
        """Probability that what is stated is meant of these focal lengths; 0 where nothing is."""
        return np.where(np.isnan(self.stated), 0.0, expit(STATED_TRUST - 0.5 * self._off(log_focal) ** 2))

    def _off(self, log_focal: Float[np.ndarray, "g"]) -> Float[np.ndarray, "g"]:
        return np.where(np.isnan(self.stated), 0.0, log_focal - self.stated) / STATED_SIGMA


@dataclass(frozen=True, eq=False)
class FocalEstimate:
    """The most probable focal lengths of groups of photos.

    information: second derivatives of the negative logarithm of the posterior. log_evidence: logarithm of the
    probability of the pairs, whatever the focal lengths of the groups are, up to a constant that is the same for all
    groupings.
    """

    log_focal: Float[np.ndarray, "g"]
    information: Float[np.ndarray, "g g"]
    log_evidence: float

    @property
    def sigma(self) -> Float[np.ndarray, "g"]:
        """Standard deviations of the logarithms: relative errors."""
        return np.sqrt(np.diag(np.linalg.inv(self.information)))


def estimate_focals(
    evidence: PairEvidence, group: Int[np.ndarray, "n"], prior: FocalPrior, start: Float[np.ndarray, "g"] | None = None
) -> FocalEstimate:
    """The most probable focal lengths of groups of photos that share one each.

    A pair's likelihood is that of its residual, Gaussian with the covariance that follows from that of F, or, for a
    false pair, flat. It is maximised by reweighted Gauss-Newton from where one offset of all focal lengths does best,
    first with a wide and then with the true covariance.

    Args:
        group: Of every photo.
        start: Logarithms to begin with, shifted by each of the best common offsets; None: the means of the prior.

    Source:
        The equations are those of `mendonca1999`, for two unknowns as in `fetzer2020`; the evidence is Laplace's
        approximation, `mackay1992`. Departure: residuals in units of their own standard deviations.
    """
    if start is None:
        start = np.where(np.isnan(prior.stated), prior.mean, prior.stated)
    found = [_climb(evidence, group, prior, y) for y in _starts(evidence, group, prior, start)]
    return max(found, key=lambda estimate: estimate.log_evidence)


def essential_residual(
    fundamentals: Float[np.ndarray, "*#b 3 3"],
    log_focal1: Float[np.ndarray, "*#b"],
    log_focal2: Float[np.ndarray, "*#b"],
) -> tuple[Float[np.ndarray, "*b 2"], Float[np.ndarray, "*b 2 3 3"]]:
    """How far E = K2^T F K1 is from two equal singular values, and the derivatives by the entries of E.

    With n the left null vector of E, and a and b the rows of E along two axes normal to n and to each other,
    r = (|a|^2 - |b|^2, 2 a.b) / (|a|^2 + |b|^2); |r| = (s1^2 - s2^2) / (s1^2 + s2^2). Another choice of axes turns r
    and its covariance alike. A tilt of n changes a and b by n^T E = 0: it has no derivative.
    """
    K1, K2 = _diagonal(log_focal1), _diagonal(log_focal2)
    E = fundamentals * K2[..., :, None] * K1[..., None, :]
    n = _left_null(E)
    # The reflection that carries the z axis to n carries x and y to axes normal to it.
    v = n + np.array([0.0, 0.0, 1.0]) * np.where(n[..., 2:] < 0, -1.0, 1.0)
    frame = np.eye(3) - 2.0 * v[..., :, None] * v[..., None, :] / np.sum(v * v, axis=-1)[..., None, None]
    e1, e2 = frame[..., 0, :], frame[..., 1, :]
    a, b = (np.einsum("...i,...ij->...j", e, E) for e in (e1, e2))
    aa, bb, ab = np.sum(a * a, axis=-1), np.sum(b * b, axis=-1), np.sum(a * b, axis=-1)
    total = aa + bb
    r = np.stack([(aa - bb) / total, 2.0 * ab / total], axis=-1)
    ea, eb = e1[..., :, None] * a[..., None, :], e2[..., :, None] * b[..., None, :]
    cross = e1[..., :, None] * b[..., None, :] + e2[..., :, None] * a[..., None, :]
    by_total = 2.0 * (ea + eb)
    by_E = np.stack([2.0 * (ea - eb), 2.0 * cross], axis=-3) - r[..., :, None, None] * by_total[..., None, :, :]
    return r, by_E / total[..., None, None, None]


def squared_distances(
    evidence: PairEvidence,
    log_focal1: Float[np.ndarray, "p *b"],
    log_focal2: Float[np.ndarray, "p *b"],
    sigma: float = SMALLEST_RESIDUAL_SIGMA,
) -> Float[np.ndarray, "p *b"]:
    """Squared Mahalanobis distance of every pair's residual from 0: for a true pair, chi^2 with 2 degrees of freedom.

    Args:
        log_focal1, log_focal2: Of the pair's photos; one or many per pair.
        sigma: Standard deviation that comes to that from the covariance of F.
    """
    r, W, _ = _whitening(evidence, log_focal1, log_focal2, sigma)
    return np.einsum("...i,...ij,...j->...", r, W, r)


def agreement(evidence: PairEvidence, log_focal: Float[np.ndarray, "n"]) -> Float[np.ndarray, "p"]:
    """Probability that each pair's F is of these focal lengths (of every photo), and not false."""
    i, j = evidence.pairs.T
    return expit(TRUST - 0.5 * squared_distances(evidence, log_focal[i], log_focal[j]))


def log_likelihood_of_photos(
    evidence: PairEvidence, log_focal: Float[np.ndarray, "n"], photos: Int[np.ndarray, "m"], other: float
) -> Float[np.ndarray, "m"]:
    """Of the pairs of each of some photos, if this photo alone had another focal length.

    Args:
        log_focal: Of every photo.
    """
    i, j = evidence.pairs.T
    changed = [
        _log_likelihood(squared_distances(evidence, *ends))
        for ends in ((np.full(len(i), other), log_focal[j]), (log_focal[i], np.full(len(j), other)))
    ]
    total = np.bincount(i, changed[0], len(log_focal)) + np.bincount(j, changed[1], len(log_focal))
    return total[photos]


def _whitening(evidence: PairEvidence, log_focal1, log_focal2, sigma: float):
    """Residuals, the inverses of their covariances, and their derivatives by both logarithms."""
    extra = (slice(None), *(None,) * (log_focal1.ndim - 1))
    r, by_E = essential_residual(evidence.fundamentals[extra], log_focal1, log_focal2)
    K1, K2 = _diagonal(log_focal1), _diagonal(log_focal2)
    by_F = by_E * K2[..., None, :, None] * K1[..., None, None, :]
    # E = K2 F K1 grows with log f1 as its first two columns do, with log f2 as its first two rows.
    weighted = by_F * evidence.fundamentals[extra][..., None, :, :]
    by_focals = np.stack(
        [np.sum(weighted[..., :2], axis=(-1, -2)), np.sum(weighted[..., :2, :], axis=(-1, -2))], axis=-1
    )
    flat = by_F.reshape(*by_F.shape[:-2], 9)
    S = np.einsum("p...ai,pij,p...bj->p...ab", flat, evidence.covariances, flat, optimize=True)
    return r, np.linalg.inv(S + sigma**2 * np.eye(2)), by_focals


def _diagonal(log_focal: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b 3"]:
    """The diagonal of K."""
    f = np.exp(log_focal)
    return np.stack([f, f, np.ones_like(f)], axis=-1)


def _left_null(E: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Unit left null vectors of matrices of rank 2: the longest cross product of two columns."""
    columns = np.swapaxes(E, -1, -2)
    normals = np.cross(columns, np.roll(columns, -1, axis=-2))
    length = np.linalg.norm(normals, axis=-1)
    longest = np.argmax(length, axis=-1)[..., None]
    n = np.take_along_axis(normals, longest[..., None], axis=-2)[..., 0, :]
    return n / np.maximum(np.take_along_axis(length, longest, axis=-1), 1e-300)


def _log_likelihood(distances: Float[np.ndarray, "*b"]) -> Float[np.ndarray, "*b"]:
    """log(1 + exp(TRUST - d / 2)): true or false, over false."""
    return np.logaddexp(0.0, TRUST - 0.5 * distances)


def _starts(evidence: PairEvidence, group, prior: FocalPrior, start) -> list[Float[np.ndarray, "g"]]:
    """The start itself, and where one offset of all groups (less, the better they are known) does best."""
    # A group that is known well moves little when the others are moved.
    spread = np.where(np.isnan(prior.stated), prior.sigma, np.minimum(prior.sigma, STATED_SIGMA))
    share = spread / spread.max()
    offsets = GRID - np.average(start, weights=share)
    y = start[:, None] + share[:, None] * offsets
    i, j = (group[evidence.pairs[:, k]] for k in (0, 1))
    fit = _log_likelihood(squared_distances(evidence, y[i], y[j])).sum(axis=0)
    peaks = [k for k in range(len(GRID)) if fit[k] >= fit[max(k - 1, 0)] and fit[k] >= fit[min(k + 1, len(GRID) - 1)]]
    best = sorted(peaks, key=lambda k: (-fit[k], k))[:MAX_STARTS]
    # A peak beside the start is the same hill.
    return [start, *(y[:, k] for k in best if abs(offsets[k]) > GRID[1] - GRID[0])]


def _climb(evidence: PairEvidence, group, prior: FocalPrior, y: Float[np.ndarray, "g"]) -> FocalEstimate:
    """The nearest maximum of the posterior."""
    for sigma in (COARSE_SIGMA, SMALLEST_RESIDUAL_SIGMA):
        value, damping = _log_posterior(evidence, group, prior, y, sigma), 1e-3
        for _ in range(ITERATIONS):
            gradient, information = _normal_equations(evidence, group, prior, y, sigma)
            before = value
            while value <= before and damping < LARGEST_DAMPING:
                step = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
                moved = y + step * min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-300))
                moved_value = _log_posterior(evidence, group, prior, moved, sigma)
                if moved_value > before:
                    y, value, damping = moved, moved_value, max(damping / 5.0, 1e-6)
                else:
                    damping *= 5.0
            if value - before < TOLERANCE:
                break
    _, information = _normal_equations(evidence, group, prior, y, SMALLEST_RESIDUAL_SIGMA)
    value = _log_posterior(evidence, group, prior, y, SMALLEST_RESIDUAL_SIGMA)
    occam = 0.5 * float(np.linalg.slogdet(information * prior.sigma[:, None] * prior.sigma)[1])
    return FocalEstimate(y, information, value - occam)


def _log_posterior(evidence: PairEvidence, group, prior: FocalPrior, y, sigma: float) -> float:
    i, j = (group[evidence.pairs[:, k]] for k in (0, 1))
    fit = _log_likelihood(squared_distances(evidence, y[i], y[j], sigma)).sum()
    return float(fit) + prior.log_density(y)


def _normal_equations(evidence: PairEvidence, group, prior: FocalPrior, y, sigma: float):
    """Gradient of the logarithm of the posterior, and the Gauss-Newton approximation of its negative Hessian."""
    ends = [group[evidence.pairs[:, k]] for k in (0, 1)]
    r, W, by_focals = _whitening(evidence, y[ends[0]], y[ends[1]], sigma)
    # The probability that the pair is a true one.
    weight = expit(TRUST - 0.5 * np.einsum("pi,pij,pj->p", r, W, r))
    J_W = weight[:, None, None] * np.einsum("pia,pij->paj", by_focals, W)
    blocks, slopes = np.einsum("paj,pjb->pab", J_W, by_focals), np.einsum("paj,pj->pa", J_W, r)
    gradient, curvature = prior.derivatives(y)
    information = np.diag(curvature)
    for a in (0, 1):
        np.add.at(gradient, ends[a], -slopes[:, a])
        for b in (0, 1):
            np.add.at(information, (ends[a], ends[b]), blocks[:, a, b])
    return gradient, information
