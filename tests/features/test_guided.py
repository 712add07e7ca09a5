import numpy as np
import pytest

from fieldstone.features.guided import match_guided, near_epipolar_lines
from fieldstone.features.guided_numba import match_guided_numba
from fieldstone.features.matching import match_mutual
from fieldstone.geometry.epipolar import epipolar_lines, essential_from_pose, fundamental_from_essential
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.scene.features import Features

IMPLEMENTATIONS = [match_guided, match_guided_numba]
K = np.array([[700.0, 0, 400], [0, 700, 300], [0, 0, 1]])
MOTIONS = {
    "sideways": Rigid3(exp(np.array([0.02, 0.1, -0.03])), np.array([1.0, 0.1, 0.05])),
    "forward": Rigid3(exp(np.array([0.01, 0.0, 0.2])), np.array([0.05, -0.1, 1.0])),
    "upward": Rigid3(np.eye(3), np.array([0.0, 1.0, 0.0])),
}


def features_of(pixels: np.ndarray, descriptors: np.ndarray) -> Features:
    n = len(pixels)
    return Features(pixels, np.ones(n), np.zeros(n), descriptors, np.zeros((n, 3), dtype=np.uint8))


def scene(motion: Rigid3, seed: int, count: int = 300) -> tuple[Features, Features, np.ndarray]:
    """Two photos of the same points in shuffled order; a third of the descriptors occurs twice in each photo."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-2, 2, size=(count, 2)), rng.uniform(4, 8, size=(count, 1))], axis=1)
    moved = motion.apply(points)
    pixels1, pixels2 = ((p / p[:, 2:] @ K.T)[:, :2] + rng.normal(0, 0.3, size=(count, 2)) for p in (points, moved))
    descriptors = rng.integers(0, 120, size=(count, 128))
    descriptors[: count // 6] = descriptors[count // 6 : count // 6 * 2]
    noisy = [np.clip(descriptors + rng.integers(-6, 7, size=(count, 128)), 0, 255).astype(np.uint8) for _ in range(2)]
    shuffled = rng.permutation(count)
    F = fundamental_from_essential(essential_from_pose(motion), K, K)
    return features_of(pixels1, noisy[0]), features_of(pixels2[shuffled], noisy[1][shuffled]), F


@pytest.mark.parametrize("motion", MOTIONS, ids=str)
def test_kernel_gives_the_matches_of_the_reference(motion):
    for seed in range(3):
        a, b, F = scene(MOTIONS[motion], seed)
        for error in (0.5, 3.0, 1e4):
            expected = match_guided(a, b, F, error, 0.8)
            np.testing.assert_array_equal(match_guided_numba(a, b, F, error, 0.8), expected)
            exchanged = match_guided_numba(b, a, F.T, error, 0.8)
            np.testing.assert_array_equal(exchanged[np.argsort(exchanged[:, 1])][:, ::-1], expected)


@pytest.mark.parametrize("match", IMPLEMENTATIONS)
def test_geometry_saves_repeated_structure_from_the_ratio_test(match):
    a, b, F = scene(MOTIONS["sideways"], 7)
    plain, guided = match_mutual(a, b, 0.8), match(a, b, F, 2.0, 0.8)
    assert len(guided) > len(plain) + 50
    lines = epipolar_lines(F, a.keypoints[guided[:, 0]])
    offsets = np.abs(np.sum(lines[:, :2] * b.keypoints[guided[:, 1]], axis=1) + lines[:, 2])
    assert offsets.max() <= 2.0


@pytest.mark.parametrize("match", IMPLEMENTATIONS)
def test_a_band_as_wide_as_the_photo_changes_nothing(match):
    a, b, F = scene(MOTIONS["sideways"], 2)
    np.testing.assert_array_equal(match(a, b, F, 1e6, 0.8), match_mutual(a, b, 0.8))
    assert match(a[:0], b, F, 2.0, 0.8).shape == (0, 2)
    assert match(a, b[:0], F, 2.0, 0.8).shape == (0, 2)


def test_agreement_is_the_distance_to_both_lines():
    a, b, F = scene(MOTIONS["forward"], 1, count=60)
    agrees = near_epipolar_lines(a.keypoints, b.keypoints, F, 5.0)
    lines2, lines1 = epipolar_lines(F, a.keypoints), epipolar_lines(F.T, b.keypoints)
    for i in range(0, 60, 7):
        for j in range(60):
            d2 = abs(lines2[i, :2] @ b.keypoints[j] + lines2[i, 2])
            d1 = abs(lines1[j, :2] @ a.keypoints[i] + lines1[j, 2])
            assert agrees[i, j] == (max(d1, d2) <= 5.0)
