"""Which pairs of photos are worth matching.

A chooser is a function from `PhotosToPair` to pairs. A new one is written here and named in `CHOOSERS`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from fieldstone.features.matching import match_mutual
from fieldstone.features.retrieval import VladOptions, similarities
from fieldstone.scene.features import Features
from fieldstone.scene.match_graph import ImagePair

logger = logging.getLogger(__name__)


def exhaustive(features: Sequence[Features]) -> list[ImagePair]:
    """All pairs (i, j), i < j, of photos that have features."""
    filled = [i for i, f in enumerate(features) if len(f)]
    return [(i, j) for k, i in enumerate(filled) for j in filled[k + 1 :]]


def sequential(num_photos: int, window: int) -> list[ImagePair]:
    """Pairs of photos at most `window` places apart in the order in which they were taken."""
    return [(i, j) for i in range(num_photos) for j in range(i + 1, min(i + window + 1, num_photos))]


def nearby(positions: Float[np.ndarray, "n 3"], num_neighbors: int) -> list[ImagePair]:
    """Pairs of each photo with the `num_neighbors` taken nearest to it.

    Args:
        positions: In one Cartesian frame, any unit; rows with nan (photos without GPS) get no pair.
    """
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if len(known) < 2:
        return []
    distance = np.linalg.norm(positions[known][:, None] - positions[known], axis=2)
    np.fill_diagonal(distance, np.inf)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, : min(num_neighbors, len(known) - 1)]
    return ordered((int(known[i]), int(known[j])) for i, row in enumerate(nearest) for j in row)


def ordered(pairs: Iterable[tuple[int, int]]) -> list[ImagePair]:
    """The pairs as (smaller, larger), once each, sorted."""
    return sorted({(int(min(p)), int(max(p))) for p in pairs})


@dataclass(frozen=True)
class PairOptions:
    """How pairs are chosen, how many of them, and how closely they are compared before."""

    chooser: Literal["automatic", "exhaustive", "similar", "sequential"] = "automatic"
    """automatic: all pairs of small sets, similar ones of large sets."""
    max_exhaustive: int = 12
    """Up to this many photos, automatic takes all pairs."""
    window: int = 10
    """Photos that are at most so many places apart in their order make the pairs of `sequential`."""
    num_candidates: int = 25
    """Most similar photos of each photo, whose few largest features are matched to rank them."""
    num_indirect: int = 15
    """Then as many photos of each photo that share the most good partners with it."""
    num_preview: int = 1024
    """Features of the largest scale used for that: a hundredth of the work of all of them."""
    preview_ratio: float = 0.7
    """Ratio test of the preview: stricter than that of matching, as a few false matches blur the ranking."""
    min_preview: int = 6
    """Pairs with fewer previewed matches are left out, except for the best few of each photo and the trees."""
    num_neighbors: int = 20
    """Partners of each photo that are matched wholly, at most."""
    num_certain: int = 3
    """Partners of each photo that are matched wholly, however few previewed matches they have."""
    num_trees: int = 3
    """Spanning trees added, so that no group of photos stays without a tie to the others."""
    vlad: VladOptions = field(default_factory=VladOptions)

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ValueError(f"window must be at least 1, got {self.window}")
        counts = (self.num_candidates, self.num_preview, self.num_neighbors, self.num_certain)
        if min(counts) < 1 or self.num_trees < 0:
            raise ValueError(f"numbers of candidates, features and partners must be at least 1, got {counts}")


@dataclass(frozen=True, eq=False)
class PhotosToPair:
    """What is known of photos before any two of them are matched."""

    features: Sequence[Features]
    """In the order of the photos' names."""
    positions: Float[np.ndarray, "n 3"] | None
    """In one Cartesian frame; rows with nan where there is no GPS."""
    rng: np.random.Generator
    threads: int


PairChooser = Callable[[PhotosToPair, PairOptions], list[ImagePair]]


def choose_pairs(
    features: Sequence[Features],
    options: PairOptions,
    rng: np.random.Generator,
    *,
    positions: Float[np.ndarray, "n 3"] | None = None,
    threads: int = 1,
) -> list[ImagePair]:
    """The pairs of the chooser that the options name; photos without features have none."""
    pairs = CHOOSERS[options.chooser](PhotosToPair(features, positions, rng, threads), options)
    return [pair for pair in pairs if all(len(features[k]) for k in pair)]


def automatic_pairs(photos: PhotosToPair, options: PairOptions) -> list[ImagePair]:
    """All pairs of small sets; of large ones those of `similar_pairs`."""
    if len(photos.features) <= options.max_exhaustive:
        return exhaustive(photos.features)
    return similar_pairs(photos, options)


def similar_pairs(photos: PhotosToPair, options: PairOptions) -> list[ImagePair]:
    """Pairs of photos that are similar, in number proportional to the photos.

    Candidates by similarity as a whole (and by position, where it is known) are ranked by how many of their largest
    features match, and so are the partners of their good partners; every photo keeps its best partners, and spanning
    trees of the same ranking tie the rest.

    Source:
        Matching a few large features first: `wu2013`, section 3.
    """
    features, positions, threads = photos.features, photos.positions, photos.threads
    similarity = similarities(features, options.vlad, photos.rng)
    empty = np.array([len(f) == 0 for f in features])
    similarity[empty] = similarity[:, empty] = -np.inf
    np.fill_diagonal(similarity, -np.inf)
    candidates = set(most_similar(similarity, options.num_candidates))
    if positions is not None:
        candidates |= {p for p in nearby(positions, options.num_candidates // 2) if np.isfinite(similarity[p])}
    pairs = sorted(candidates)
    counts = preview_counts(features, pairs, options, threads=threads)
    indirect = partners_of_partners(
        [p for p, c in zip(pairs, counts, strict=True) if c >= options.min_preview], len(features), options.num_indirect
    )
    unseen = [p for p in indirect if p not in candidates]
    pairs = pairs + unseen
    counts = np.concatenate([counts, preview_counts(features, unseen, options, threads=threads)])
    # Similarity lies within (-1, 1): it decides between pairs with the same number of matches.
    score = counts + 0.5 * np.array([similarity[p] for p in pairs])
    good = counts >= options.min_preview
    chosen = strongest(pairs, score, len(features), options.num_certain)
    chosen |= strongest(
        [p for p, g in zip(pairs, good, strict=True) if g], score[good], len(features), options.num_neighbors
    )
    chosen |= spanning_trees(pairs, score, len(features), options.num_trees)
    logger.info("%d photos: %d pairs chosen of %d candidates", len(features), len(chosen), len(pairs))
    return sorted(chosen)


CHOOSERS: dict[str, PairChooser] = {
    "automatic": automatic_pairs,
    "exhaustive": lambda photos, options: exhaustive(photos.features),
    "similar": similar_pairs,
    "sequential": lambda photos, options: sequential(len(photos.features), options.window),
}


def most_similar(similarity: Float[np.ndarray, "n n"], count: int) -> list[ImagePair]:
    """Pairs of each photo with the `count` others of the largest finite similarity."""
    best = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
    return ordered((i, int(j)) for i, row in enumerate(best) for j in row if np.isfinite(similarity[i, j]))


def partners_of_partners(pairs: Sequence[ImagePair], num_photos: int, count: int) -> list[ImagePair]:
    """For each photo the `count` others, not its partners, with which it has the most partners in common."""
    ends = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    ones = np.ones(len(ends), dtype=np.int32)
    half = coo_matrix((ones, (ends[:, 0], ends[:, 1])), shape=(num_photos, num_photos)).tocsr()
    partners = half + half.T
    common = (partners @ partners).tolil()
    found = []
    for photo, (others, shared) in enumerate(zip(common.rows, common.data, strict=True)):
        known = {photo, *partners.indices[partners.indptr[photo] : partners.indptr[photo + 1]].tolist()}
        ranked = sorted((-number, other) for other, number in zip(others, shared, strict=True) if other not in known)
        found += [(photo, other) for _, other in ranked[:count]]
    return ordered(found)


def preview_counts(
    features: Sequence[Features], pairs: Sequence[ImagePair], options: PairOptions, *, threads: int = 1
) -> Int[np.ndarray, "p"]:
    """Number of matches among the features of the largest scale of each pair."""
    first = [f[np.argsort(-f.scale, kind="stable")[: options.num_preview]] for f in features]
    with ThreadPoolExecutor(threads) as pool:
        counts = pool.map(lambda p: len(match_mutual(first[p[0]], first[p[1]], options.preview_ratio)), pairs)
        return np.fromiter(counts, dtype=np.int64, count=len(pairs))


def strongest(pairs: Sequence[ImagePair], score: Float[np.ndarray, "p"], num_photos: int, count: int) -> set[ImagePair]:
    """The `count` best pairs of every photo."""
    of_photo: list[list[int]] = [[] for _ in range(num_photos)]
    for k in np.argsort(-score, kind="stable").tolist():
        for photo in pairs[k]:
            of_photo[photo].append(k)
    return {pairs[k] for ranked in of_photo for k in ranked[:count]}


def spanning_trees(
    pairs: Sequence[ImagePair], score: Float[np.ndarray, "p"], num_photos: int, count: int
) -> set[ImagePair]:
    """The union of `count` maximum spanning trees (forests), each of the pairs that the ones before it left."""
    chosen: set[ImagePair] = set()
    left = np.arange(len(pairs))
    ends = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    for _ in range(count):
        if not len(left):
            break
        # Costs must be positive for the sparse format; equal scores go to the lower pair.
        rank = np.empty(len(left))
        rank[np.argsort(-score[left], kind="stable")] = np.arange(1, len(left) + 1)
        cost = coo_matrix((rank, (ends[left, 0], ends[left, 1])), shape=(num_photos, num_photos))
        tree = minimum_spanning_tree(cost.tocsr()).tocoo()
        edges = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
        chosen |= edges
        left = np.array([k for k in left.tolist() if pairs[k] not in edges], dtype=np.int64)
    return chosen
