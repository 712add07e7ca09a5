from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from fieldstone.features.pairs import (
    PairOptions,
    choose_pairs,
    exhaustive,
    nearby,
    partners_of_partners,
    sequential,
    spanning_trees,
    strongest,
)
from fieldstone.features.retrieval import VladOptions, learn_words, nearest_word, similarities, vlad
from fieldstone.scene.features import Features


def features_of(descriptors: np.ndarray) -> Features:
    n = len(descriptors)
    scale = np.linspace(9.0, 1.0, n)
    return Features(np.zeros((n, 2)), scale, np.zeros(n), descriptors, np.zeros((n, 3), dtype=np.uint8))


def walk(num_photos: int, rng: np.random.Generator, *, shared: int = 25, per_photo: int = 100) -> list[Features]:
    """Photos along a walk: each shows `shared` new things; what photos less than four apart see overlaps."""
    things = rng.gamma(0.6, 40.0, size=(shared * (num_photos + 4), 128)).clip(0, 200)
    photos = []
    for k in range(num_photos):
        seen = things[shared * k : shared * k + per_photo] + rng.normal(0, 4, size=(per_photo, 128))
        photos.append(features_of(seen.clip(0, 255)[rng.permutation(per_photo)].astype(np.uint8)))
    return photos


def test_small_sets_are_matched_wholly_and_large_ones_where_they_overlap():
    rng = np.random.default_rng(0)
    photos = walk(12, rng)
    assert choose_pairs(photos, PairOptions(), rng) == exhaustive(photos)
    photos = walk(60, rng)
    options = PairOptions(num_candidates=12, num_preview=64)
    pairs = choose_pairs(photos, options, np.random.default_rng(1))
    overlapping = {(i, j) for i, j in combinations(range(60), 2) if j - i <= 2}
    assert overlapping <= set(pairs)
    assert len(pairs) < 0.25 * 60 * 59 / 2
    assert pairs == choose_pairs(photos, options, np.random.default_rng(1), threads=2)


def test_the_chooser_is_the_one_that_is_named():
    rng = np.random.default_rng(0)
    photos = [*walk(14, rng), features_of(np.empty((0, 128), dtype=np.uint8))]
    assert choose_pairs(photos, PairOptions(chooser="exhaustive"), rng) == list(combinations(range(14), 2))
    expected = [(i, j) for i, j in combinations(range(14), 2) if j - i <= 3]
    assert choose_pairs(photos, PairOptions(chooser="sequential", window=3), rng) == expected
    similar = PairOptions(chooser="similar", num_candidates=4, num_preview=64)
    automatic = replace(similar, chooser="automatic")
    chosen = [choose_pairs(photos, options, np.random.default_rng(1)) for options in (similar, automatic)]
    assert chosen[0] == chosen[1]
    assert choose_pairs(photos[:5], automatic, rng) == exhaustive(photos[:5])
    with pytest.raises(ValueError, match="window"):
        PairOptions(window=0)


def test_photos_without_features_get_no_pair():
    rng = np.random.default_rng(0)
    photos = walk(20, rng)
    photos[7] = features_of(np.empty((0, 128), dtype=np.uint8))
    pairs = choose_pairs(photos, PairOptions(num_candidates=6, num_preview=64), rng)
    assert {i for pair in pairs for i in pair} == set(range(20)) - {7}
    assert all(7 not in pair for pair in exhaustive(photos))
    nothing = [photos[7]] * 20
    assert choose_pairs(nothing, PairOptions(), rng) == []
    assert choose_pairs([], PairOptions(), rng) == []


def test_two_walks_that_share_nothing_stay_connected_inside():
    rng = np.random.default_rng(3)
    photos = walk(20, rng) + walk(20, rng)
    pairs = choose_pairs(photos, PairOptions(num_candidates=10, num_preview=100), rng)
    inside = {p for p in pairs if (p[0] < 20) == (p[1] < 20)}
    reached = {0}
    for _ in range(40):
        reached |= {j for p in inside for j in p if reached & set(p)}
    assert reached == set(range(20))


def test_spanning_trees_are_the_heaviest():
    rng = np.random.default_rng(0)
    n = 7
    pairs = list(combinations(range(n), 2))
    score = rng.permutation(len(pairs)).astype(float)

    def connects(edges) -> bool:
        group = list(range(n))
        for i, j in edges:
            group = [group[i] if g == group[j] else g for g in group]
        return len(set(group)) == 1

    best = max(
        (c for c in combinations(range(len(pairs)), n - 1) if connects([pairs[k] for k in c])),
        key=lambda c: score[list(c)].sum(),
    )
    assert spanning_trees(pairs, score, n, 1) == {pairs[k] for k in best}
    two = spanning_trees(pairs, score, n, 2)
    assert len(two) == 2 * (n - 1)
    assert connects(two - {pairs[k] for k in best})
    assert spanning_trees(pairs, score, n, 50) == set(pairs)
    assert spanning_trees([], np.empty(0), n, 2) == set()


def test_partners_of_partners_are_ranked_by_common_partners():
    # 0 and 3 share 1 and 2; 0 and 4 share 2 only; 5 knows nobody.
    pairs = [(0, 1), (0, 2), (1, 3), (2, 3), (2, 4)]
    assert partners_of_partners(pairs, 6, 9) == [(0, 3), (0, 4), (1, 2), (3, 4)]
    assert partners_of_partners(pairs[:-1] + [(2, 4)], 6, 1) == [(0, 3), (0, 4), (1, 2)]
    assert partners_of_partners([], 6, 3) == []


def test_every_photo_keeps_its_strongest_pairs():
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)]
    score = np.array([5.0, 4.0, 1.0, 3.0, 2.0])
    assert strongest(pairs, score, 4, 1) == {(0, 1), (0, 2), (2, 3)}
    assert strongest(pairs, score, 4, 9) == set(pairs)


def test_pairs_by_order_and_by_place():
    assert sequential(4, 2) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert sequential(0, 3) == sequential(1, 3) == []
    line = np.array([[0.0, 0, 0], [1, 0, 0], [np.nan, 0, 0], [10, 0, 0], [11.5, 0, 0]])
    assert nearby(line, 1) == [(0, 1), (3, 4)]
    assert nearby(line, 9) == [(0, 1), (0, 3), (0, 4), (1, 3), (1, 4), (3, 4)]
    assert nearby(line[2:3], 3) == []


def test_words_are_the_centres_of_clusters():
    rng = np.random.default_rng(0)
    centers = rng.uniform(20, 200, size=(5, 128))
    photos = [(c + rng.normal(0, 3, size=(80, 128))).round().clip(0, 255).astype(np.uint8) for c in centers]
    words = learn_words(photos, 5, np.random.default_rng(4))
    distance = np.linalg.norm(words[:, None] - centers, axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == [0, 1, 2, 3, 4]
    assert distance.min(axis=1).max() < 3 * np.sqrt(128 / 80) * 1.5
    values = photos[2].astype(np.float32)
    word, squared = nearest_word(values, words)
    brute = ((values[:, None] - words) ** 2).sum(axis=2)
    np.testing.assert_array_equal(word, brute.argmin(axis=1))
    # A difference of float32 numbers of the size of |value|^2.
    np.testing.assert_allclose(squared, brute.min(axis=1), atol=2e-6 * float((values**2).sum(axis=1).max()))


def test_vlad_is_the_normalised_sum_of_differences():
    rng = np.random.default_rng(1)
    words = rng.uniform(0, 200, size=(6, 128)).astype(np.float32)
    descriptors = rng.integers(0, 200, size=(30, 128)).astype(np.uint8)
    expected = np.zeros((6, 128))
    for d in descriptors.astype(float):
        k = np.argmin(((d - words) ** 2).sum(axis=1))
        expected[k] += d - words[k]
    expected /= np.maximum(np.linalg.norm(expected, axis=1, keepdims=True), 1e-6)
    expected /= np.linalg.norm(expected)
    np.testing.assert_allclose(vlad(descriptors, words), expected.reshape(-1), atol=1e-5)
    assert not vlad(descriptors[:0], words).any()


def test_similarity_falls_with_the_distance_along_the_walk():
    alike = similarities(walk(40, np.random.default_rng(2)), VladOptions(num_words=16), np.random.default_rng(0))
    np.testing.assert_allclose(np.diag(alike), 1.0, atol=1e-5)
    np.testing.assert_allclose(alike, alike.T, atol=1e-6)
    by_gap = [np.mean(np.diag(alike, k)) for k in (1, 2, 3, 6)]
    assert by_gap[0] > by_gap[1] > by_gap[2] > by_gap[3]
    assert np.mean(np.diag(alike, 1)) > np.max(np.diag(alike, 10))


def test_options_refuse_nonsense():
    for wrong in (
        lambda: PairOptions(num_candidates=0),
        lambda: PairOptions(num_certain=0),
        lambda: VladOptions(num_words=0),
    ):
        with pytest.raises(ValueError):
            wrong()
