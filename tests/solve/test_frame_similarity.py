import numpy as np
import pytest

from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.geometry.sim3 import Sim3
from fieldstone.solve.robust.frame_similarity import Sightings, errors_px, estimate_frame_similarity

FOCAL = 900.0


def sightings(a_from_b: Sim3, count: int, rng: np.random.Generator, *, noise_px: float = 0.0) -> Sightings:
    """Photos about the origin of a that see points of b, and the other way round, all before their cameras."""
    points_in_a, centers_in_a = rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) * 2.0 + [0.0, 0.0, 9.0]
    rays = points_in_a - centers_in_a
    rays += np.linalg.norm(rays, axis=1, keepdims=True) * rng.normal(scale=noise_px / FOCAL, size=rays.shape)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    from_a = np.arange(count) % 2 == 0
    b_from_a = a_from_b.inverse()
    return Sightings(
        from_a=from_a,
        in_a=np.where(from_a[:, None], centers_in_a, points_in_a),
        in_b=b_from_a.apply(np.where(from_a[:, None], points_in_a, centers_in_a)),
        rays=np.where(from_a[:, None], rays, rays @ b_from_a.R.T),
        focals=np.full(count, FOCAL),
    )


def truth(rng: np.random.Generator) -> Sim3:
    return Sim3(float(np.exp(rng.normal())), random_rotation(1, rng)[0], rng.normal(size=3) * 5.0)


@pytest.mark.parametrize("seed", range(10))
def test_exact_sightings_give_the_similarity(seed):
    rng = np.random.default_rng(seed)
    true = truth(rng)
    seen = sightings(true, 14, rng)
    # The rotation is known to a few degrees, as from one pair of photos; a wrong one is tried too.
    hints = np.stack([random_rotation(1, rng)[0], exp(rng.normal(scale=0.03, size=3)) @ true.R])
    found = estimate_frame_similarity(seen, hints, 8.0, rng)
    assert found is not None
    assert found.inliers.all()
    assert angle_between(found.a_from_b.R, true.R) < 1e-5
    np.testing.assert_allclose(found.a_from_b.scale, true.scale, rtol=1e-5)
    np.testing.assert_allclose(found.a_from_b.t, true.t, atol=1e-4)


def test_false_sightings_are_no_inliers():
    rng = np.random.default_rng(0)
    true = truth(rng)
    seen = sightings(true, 60, rng, noise_px=0.5)
    false = np.arange(60) < 24
    seen.in_b[false] = rng.permutation(seen.in_b[false], axis=0)
    found = estimate_frame_similarity(seen, true.R[None], 8.0, rng)
    assert found is not None
    assert found.inliers[~false].all()
    assert found.inliers[false].sum() <= 2
    # Half a pixel of noise on 36 sightings.
    assert angle_between(found.a_from_b.R, true.R) < 3 * 0.5 / FOCAL


def test_points_behind_their_photo_have_no_error():
    rng = np.random.default_rng(0)
    true = truth(rng)
    seen = sightings(true, 8, rng)
    np.testing.assert_allclose(errors_px(true, seen), 0.0, atol=1e-6)
    behind = Sightings(seen.from_a, seen.in_a, seen.in_b, -seen.rays, seen.focals)
    assert np.isinf(errors_px(true, behind)).all()


def test_too_few_sightings_give_nothing():
    rng = np.random.default_rng(0)
    true = truth(rng)
    for count in (0, 1, 3):
        assert estimate_frame_similarity(sightings(true, count, rng), true.R[None], 8.0, rng) is None
