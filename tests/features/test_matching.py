import numpy as np
import pytest

from fieldstone.features.matching import MAX_GROWTH, MAX_TURN, match_faint, match_mutual, of_one_motion
from fieldstone.scene.features import Features


def features_of(descriptors: np.ndarray) -> Features:
    """Features with these descriptors at arbitrary places."""
    n = len(descriptors)
    return Features(np.zeros((n, 2)), np.ones(n), np.zeros(n), descriptors, np.zeros((n, 3), dtype=np.uint8))


def random_descriptors(n: int, rng: np.random.Generator, high: int = 120) -> np.ndarray:
    return rng.integers(0, high, size=(n, 128)).astype(np.uint8)


def by_loops(a: np.ndarray, b: np.ndarray, max_ratio: float) -> list[tuple[int, int]]:
    """Mutual nearest neighbours with the ratio test both ways, straight from the definition."""

    def best(row: np.ndarray, others: np.ndarray) -> int | None:
        squared = [int(((row.astype(int) - other.astype(int)) ** 2).sum()) for other in others]
        order = sorted(range(len(squared)), key=lambda k: (squared[k], k))
        if len(order) > 1 and max_ratio < 1 and not squared[order[0]] < max_ratio**2 * squared[order[1]]:
            return None
        return order[0]

    forward = [best(row, b) for row in a]
    backward = [best(row, a) for row in b]
    return [(i, j) for i, j in enumerate(forward) if j is not None and backward[j] == i]


def noisy_copies(n: int, m: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Two sets with about half of their rows in common up to noise, some of them twice."""
    a = random_descriptors(n, rng)
    b = random_descriptors(m, rng)
    shared = min(n, m) // 2
    noise = rng.integers(-9, 10, size=(shared, 128))
    b[:shared] = np.clip(a[rng.permutation(n)[:shared]].astype(int) + noise, 0, 255)
    if m > shared + 4:
        b[shared : shared + 3] = b[:1]
    return a, b


@pytest.mark.parametrize("max_ratio", [0.8, 1.0])
@pytest.mark.parametrize(("n", "m"), [(40, 50), (1, 1), (1, 9), (9, 1), (3, 2)])
def test_matches_are_those_of_the_definition(n, m, max_ratio):
    a, b = noisy_copies(n, m, np.random.default_rng(n + m))
    matches = match_mutual(features_of(a), features_of(b), max_ratio)
    assert [tuple(row) for row in matches] == by_loops(a, b, max_ratio)


def test_exchanging_the_photos_exchanges_the_columns():
    a, b = noisy_copies(300, 240, np.random.default_rng(0))
    forward = match_mutual(features_of(a), features_of(b), 0.8)
    backward = match_mutual(features_of(b), features_of(a), 0.8)
    assert len(forward) > 100
    np.testing.assert_array_equal(forward, backward[np.argsort(backward[:, 1])][:, ::-1])


def test_no_features_no_matches():
    empty, some = features_of(np.empty((0, 128), dtype=np.uint8)), features_of(np.ones((3, 128), dtype=np.uint8))
    for pair in ((empty, some), (some, empty), (empty, empty)):
        assert match_faint(*pair).shape == (0, 2)
        assert match_mutual(*pair, 0.8).shape == (0, 2)
    with pytest.raises(ValueError, match="max_ratio"):
        match_mutual(some, some, 1.5)


def motion_by_loops(turn: list[float], growth: list[float]) -> list[bool]:
    """The matches alike to the one with most alike to it, the first of several, by vectors on the unit circle."""

    def alike(k: int, other: int) -> bool:
        cosine = np.cos(turn[k]) * np.cos(turn[other]) + np.sin(turn[k]) * np.sin(turn[other])
        return cosine > np.cos(MAX_TURN) and max(growth[k] / growth[other], growth[other] / growth[k]) < MAX_GROWTH

    numbers = range(len(turn))
    counts = [sum(alike(k, other) for other in numbers) for k in numbers]
    best = counts.index(max(counts))
    return [alike(best, other) for other in numbers]


@pytest.mark.parametrize("seed", range(5))
def test_the_most_common_motion_is_that_of_the_definition(seed):
    rng = np.random.default_rng(seed)
    turn, growth = rng.uniform(-7.0, 7.0, size=80), np.exp(rng.normal(size=80))
    turn[:20], growth[:20] = np.pi + rng.normal(0.0, 0.2, size=20), 1.5
    assert of_one_motion(turn, growth).tolist() == motion_by_loops(turn.tolist(), growth.tolist())


def test_faint_matches_turn_and_grow_alike():
    rng = np.random.default_rng(0)
    true, false = 200, 200
    a, b = noisy_copies(true + false, true + false, rng)
    b = np.clip(a.astype(int) + rng.integers(-20, 21, size=a.shape), 0, 255).astype(np.uint8)
    n = true + false
    angle, scale = rng.uniform(-np.pi, np.pi, size=n), np.exp(rng.normal(0.0, 0.7, size=n))
    turned = np.where(np.arange(n) < true, angle + 3.0 + rng.normal(0.0, 0.05, size=n), rng.uniform(-np.pi, np.pi, n))
    grown = np.where(np.arange(n) < true, 1.4 * scale, np.exp(rng.normal(0.0, 0.7, size=n)))
    keypoints, colors = np.zeros((n, 2)), np.zeros((n, 3), dtype=np.uint8)
    first = Features(keypoints, scale, angle, a, colors)
    second = Features(keypoints, grown, np.angle(np.exp(1j * turned)), b, colors)
    assert len(match_mutual(first, second, 0.95)) == n
    rows = match_faint(first, second)
    np.testing.assert_array_equal(rows[rows[:, 0] < true, 0], np.arange(true))
    # A random turn is alike with 50 of 360 degrees, and a random growth with less than half of all.
    assert np.sum(rows[:, 0] >= true) < false * 50 / 360
    np.testing.assert_array_equal(match_faint(second, first), rows[:, ::-1])
