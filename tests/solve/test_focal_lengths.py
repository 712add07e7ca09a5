"""Focal lengths from fundamental matrices: exact pairs, noisy ones, false ones, and how sure the answer is."""

import numpy as np
import pytest

from fieldstone.geometry.epipolar import essential_from_pose, homogeneous, sampson_error
from fieldstone.solve.averaging.focal_lengths import (
    STATED_SIGMA,
    FocalPrior,
    PairEvidence,
    essential_residual,
    estimate_focals,
    log_likelihood_of_photos,
    squared_distances,
)
from fieldstone.solve.robust import fundamental_covariance as covariance
from fieldstone.solve.robust.fundamental_covariance import directions, fundamental_covariance, with_rank_two
from pair_worlds import PIXEL, nothing_known, poses, refined, world


def test_the_residual_is_the_difference_of_the_singular_values():
    rng = np.random.default_rng(0)
    F = np.array([with_rank_two(rng.normal(size=(3, 3))) for _ in range(50)])
    y = rng.normal(size=(2, 50))
    r, _ = essential_residual(F, *y)
    f1, f2 = (np.stack([np.exp(a), np.exp(a), np.ones(50)], axis=1) for a in y)
    s = np.linalg.svd(F * f2[:, :, None] * f1[:, None, :], compute_uv=False)
    np.testing.assert_allclose(
        np.linalg.norm(r, axis=1), (s[:, 0] ** 2 - s[:, 1] ** 2) / (s[:, 0] ** 2 + s[:, 1] ** 2), rtol=1e-9, atol=1e-12
    )


def test_derivatives_of_the_residual_are_those_of_differences():
    """Of |r|^2, which no choice of axes changes, along matrices of rank 2."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        F = with_rank_two(rng.normal(size=(3, 3)))
        r, by_E = essential_residual(F, np.array(0.0), np.array(0.0))
        for D in directions(F):
            h = 1e-6
            ahead, behind = (
                essential_residual(with_rank_two(F + s * h * D), np.array(0.0), np.array(0.0))[0] for s in (1, -1)
            )
            numeric = (ahead @ ahead - behind @ behind) / (2 * h)
            analytic = 2 * r @ np.einsum("aij,ij->a", by_E, D)
            np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-7)


def test_exact_pairs_give_the_focal_length_of_every_photo():
    focals = np.array([0.6, 0.9, 1.3, 2.0, 0.75, 1.1])
    found = estimate_focals(world(focals), np.arange(6), nothing_known(6))
    np.testing.assert_allclose(np.exp(found.log_focal), focals, rtol=0.01)


def test_noisy_pairs_with_false_ones_still_agree():
    focals = np.array([0.7, 1.5, 0.7, 1.5, 0.7, 1.5, 0.7, 1.5])
    evidence = world(focals, noise=0.5 * PIXEL, seed=2)
    rng = np.random.default_rng(3)
    F = evidence.fundamentals.copy()
    F[::4] = [with_rank_two(rng.normal(size=(3, 3))) for _ in F[::4]]
    found = estimate_focals(PairEvidence(evidence.pairs, F, evidence.covariances), np.arange(8), nothing_known(8))
    np.testing.assert_allclose(np.exp(found.log_focal), focals, rtol=0.03)


def test_residuals_are_as_large_as_their_covariance_says(monkeypatch):
    """Monte Carlo with noise alone: the squared distances of true pairs have mean 2, that of chi^2."""
    monkeypatch.setattr(covariance, "CENTRE_SIGMA", 0.0)
    monkeypatch.setattr(covariance, "RADIAL_SIGMA", 0.0)
    distances = []
    for seed in range(60):
        evidence = world([0.8, 1.4], noise=0.5 * PIXEL, seed=seed)
        y = np.log([[0.8], [1.4]])
        distances.append(float(squared_distances(evidence, y[0], y[1], sigma=1e-9)[0]))
    assert abs(np.mean(distances) - 2.0) < 5 * np.std(distances) / np.sqrt(60)


@pytest.mark.parametrize("column", range(6))
def test_the_covariance_knows_of_shifted_centres_and_of_distortion(column):
    """What F changes by when the coordinates of one photo do is one standard deviation, exactly.

    For a shifted centre the new matrix is known; for distortion, it is what fits the distorted matches.
    """
    rng = np.random.default_rng(4)
    points = rng.uniform(-1.5, 1.5, size=(400, 3))
    views = poses(2, rng)
    x = [cam.apply(points)[:, :2] / cam.apply(points)[:, 2:] for cam in views]
    F = with_rank_two(essential_from_pose(views[1] @ views[0].inverse()))
    side, kind = divmod(column, 3)
    moved = [a.copy() for a in x]
    small = 1e-3
    if kind < 2:
        moved[side][:, kind] += small * covariance.CENTRE_SIGMA
    else:
        moved[side] *= 1 + small * covariance.RADIAL_SIGMA * np.sum(x[side] ** 2, axis=1, keepdims=True)
    change = refined(F, *moved) - F
    Sigma = fundamental_covariance(F, x[0], x[1], (1e-9, 1e-9))
    # The noise of the matches is all but nothing here: six directions are left, and this is one of them.
    values, vectors = np.linalg.eigh(Sigma)
    kept = vectors[:, values > 1e-9 * values[-1]]
    assert kept.shape[1] == 6
    whitened = kept.T @ change.ravel() / np.sqrt(values[values > 1e-9 * values[-1]])
    np.testing.assert_allclose(np.linalg.norm(whitened) / small, 1.0, rtol=0.01)


def test_standard_deviations_cover_the_errors():
    """Of noise and prior; the allowance for lenses makes them larger, never smaller."""
    off = []
    focals = np.array([0.8, 1.4, 1.0, 0.6])
    for seed in range(25):
        found = estimate_focals(world(focals, noise=0.5 * PIXEL, seed=seed), np.arange(4), nothing_known(4))
        off.append((found.log_focal - np.log(focals)) / found.sigma)
    assert np.sqrt(np.mean(np.square(off))) < 1.2


def test_the_evidence_tells_one_camera_from_several():
    for seed in range(5):
        one, two = world([1.0] * 6, 0.5 * PIXEL, seed), world([1.0, 1.3] * 3, 0.5 * PIXEL, seed)
        shared, in_turn = np.zeros(6, dtype=np.int64), np.arange(6) % 2
        for evidence, better, worse in ((one, shared, in_turn), (two, in_turn, shared)):
            found = [estimate_focals(evidence, g, nothing_known(g.max() + 1)).log_evidence for g in (better, worse)]
            assert found[0] > found[1] + 2


def test_a_stated_focal_length_is_believed_until_pairs_contradict_it():
    evidence = world([1.0] * 5, 0.5 * PIXEL, 1)
    one = np.zeros(5, dtype=np.int64)
    for stated, believed in ((1.03, True), (1.8, False), (0.56, False)):
        prior = FocalPrior(np.log([1.2]), np.array([0.45]), np.log([stated]))
        found = estimate_focals(evidence, one, prior)
        assert (prior.belief(found.log_focal)[0] > 0.5) == believed
        assert abs(found.log_focal[0]) < STATED_SIGMA
    nobody = FocalPrior(np.log([1.2]), np.array([0.45]), np.log([1.8]))
    empty = PairEvidence(np.empty((0, 2), dtype=np.int64), np.empty((0, 3, 3)), np.empty((0, 9, 9)))
    assert abs(np.exp(estimate_focals(empty, one, nobody).log_focal[0]) - 1.8) < 0.02


def test_one_photo_with_another_focal_length_changes_its_own_pairs_alone():
    evidence = world([1.0, 1.0, 2.0], 0.5 * PIXEL)
    y = np.zeros(3)
    photos = np.arange(3)
    better = log_likelihood_of_photos(evidence, y, photos, np.log(2.0)) - log_likelihood_of_photos(
        evidence, y, photos, 0.0
    )
    assert better[2] > 2
    assert (better[:2] < 0).all()


def test_sampson_errors_of_refined_matrices_are_the_noise():
    """The oracle of this file: 300 matches less 7 degrees of freedom."""
    rng = np.random.default_rng(5)
    views, points = poses(2, rng), rng.uniform(-1.5, 1.5, size=(300, 3))
    x = [cam.apply(points)[:, :2] / cam.apply(points)[:, 2:] + 1e-3 * rng.normal(size=(300, 2)) for cam in views]
    F = refined(with_rank_two(essential_from_pose(views[1] @ views[0].inverse())), *x)
    squares = sampson_error(F, homogeneous(x[0]), homogeneous(x[1])) / 1e-6
    assert abs(squares.sum() - 293) < 5 * np.sqrt(2 * 293)
