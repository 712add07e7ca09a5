import numpy as np
import pytest

from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.solve.averaging.rotations import average_rotations, residual_rotations


def edges_of(num_views: int, per_view: int, rng: np.random.Generator):
    R = random_rotation(num_views, rng)
    chain = [(i, i + 1) for i in range(num_views - 1)]
    extra = {tuple(sorted(rng.choice(num_views, 2, replace=False).tolist())) for _ in range(per_view * num_views)}
    pairs = np.array(sorted({*chain, *extra}))
    return R, pairs, R[pairs[:, 1]] @ np.swapaxes(R[pairs[:, 0]], -1, -2)


def test_exact_edges_give_exact_rotations():
    R, pairs, relative = edges_of(30, 3, np.random.default_rng(0))
    found = average_rotations(pairs, relative, np.ones(len(pairs)))
    np.testing.assert_allclose(found, R @ R[0].T, atol=1e-9)
    np.testing.assert_allclose(residual_rotations(pairs, relative, found), 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_false_edges_do_not_count(seed):
    rng = np.random.default_rng(seed)
    R, pairs, relative = edges_of(40, 6, rng)
    relative = relative @ exp(rng.normal(scale=2e-3, size=(len(pairs), 3)))
    false = rng.random(len(pairs)) < 0.2
    relative[false] = random_rotation(int(false.sum()), rng)
    found = average_rotations(pairs, relative, rng.uniform(50, 500, len(pairs)))
    assert np.rad2deg(angle_between(found, R @ R[0].T)).max() < 0.4
    angles = np.linalg.norm(residual_rotations(pairs, relative, found), axis=1)
    assert np.array_equal(angles > np.deg2rad(5), false)


def test_noise_averages_out():
    """On a complete graph the mean error is well below that of a single edge."""
    rng = np.random.default_rng(3)
    R = random_rotation(25, rng)
    pairs = np.array([(i, j) for i in range(25) for j in range(i + 1, 25)])
    relative = R[pairs[:, 1]] @ np.swapaxes(R[pairs[:, 0]], -1, -2) @ exp(rng.normal(scale=0.02, size=(300, 3)))
    found = average_rotations(pairs, relative, np.ones(300))
    pairwise = found[pairs[:, 1]] @ np.swapaxes(found[pairs[:, 0]], -1, -2)
    truth = R[pairs[:, 1]] @ np.swapaxes(R[pairs[:, 0]], -1, -2)
    assert angle_between(pairwise, truth).mean() < 0.4 * angle_between(relative, truth).mean()


def test_separate_components_are_refused():
    with pytest.raises(ValueError, match="connected"):
        average_rotations(np.array([[0, 1], [2, 3]]), np.tile(np.eye(3), (2, 1, 1)), np.ones(2))
