"""How alike photos are as a whole: one vector of aggregated descriptors per photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.sparse import csr_matrix

from fieldstone.scene.features import Features

NUM_STEPS = 10
SAMPLES_PER_WORD = 200


@dataclass(frozen=True)
class VladOptions:
    """How photos are summarised."""

    num_words: int = 64
    """Visual words, learned on the photos themselves."""
    features_per_photo: int = 1500
    """Only so many features of the largest scale count: they are the ones that other distances still show."""

    def __post_init__(self) -> None:
        if self.num_words < 1 or self.features_per_photo < 1:
            raise ValueError(
                f"num_words and features_per_photo must be at least 1, got {self.num_words}, {self.features_per_photo}"
            )


def similarities(
    features: Sequence[Features], options: VladOptions, rng: np.random.Generator
) -> Float[np.ndarray, "n n"]:
    """How alike each two photos are, from -1 to 1 (a photo to itself: 1); 0 for photos without features."""
    used = [f.descriptors[: options.features_per_photo] for f in features]
    words = learn_words(used, options.num_words, rng)
    vectors = np.stack([vlad(descriptors, words) for descriptors in used])
    return (vectors @ vectors.T).astype(np.float64)


def learn_words(
    descriptors: Sequence[UInt8[np.ndarray, "_ d"]], num_words: int, rng: np.random.Generator
) -> Float[np.ndarray, "k d"]:
    """Centres of `num_words` clusters of the photos' descriptors (fewer if there are fewer descriptors).

    Lloyd's iterations on a sample that takes the same share of every photo; an empty cluster moves to the
    descriptor that is farthest from its own centre.
    """
    total = sum(len(d) for d in descriptors)
    if not total:
        return np.zeros((1, 128), dtype=np.float32)
    share = min(1.0, num_words * SAMPLES_PER_WORD / total)
    chosen = [np.sort(rng.choice(len(d), size=int(np.ceil(share * len(d))), replace=False)) for d in descriptors]
    sample = np.concatenate([d[rows] for d, rows in zip(descriptors, chosen, strict=True)]).astype(np.float32)
    words = sample[rng.choice(len(sample), size=min(num_words, len(sample)), replace=False)]
    for _ in range(NUM_STEPS):
        word, distance = nearest_word(sample, words)
        count = np.bincount(word, minlength=len(words))
        sums = _sum_by_word(sample, word, len(words))
        words = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], words)
        lost = np.flatnonzero(count == 0)
        words[lost] = sample[np.argsort(-distance, kind="stable")[: len(lost)]]
    return words.astype(np.float32)


def nearest_word(
    values: Float[np.ndarray, "n d"], words: Float[np.ndarray, "k d"]
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Index of and squared distance to the nearest word."""
    scores = values @ words.T - 0.5 * np.sum(words**2, axis=1)
    word = np.argmax(scores, axis=1)
    return word, np.sum(values**2, axis=1) - 2 * scores[np.arange(len(values)), word]


def _sum_by_word(
    values: Float[np.ndarray, "n d"], word: Int[np.ndarray, "n"], num_words: int
) -> Float[np.ndarray, "k d"]:
    """Sums of the rows that belong to each word."""
    belongs = csr_matrix((np.ones(len(word), dtype=np.float32), (word, np.arange(len(word)))), (num_words, len(word)))
    return belongs @ values


def vlad(descriptors: UInt8[np.ndarray, "n d"], words: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k*d"]:
    """Sum of the differences between descriptors and their word, per word; each of unit length, then all together.

    Source:
        `jegou2010`, section 3; normalised per word as `arandjelovic2013`, section 3.
    """
    out = np.zeros(words.shape, dtype=np.float32)
    if len(descriptors):
        values = descriptors.astype(np.float32)
        word, _ = nearest_word(values, words)
        out = _sum_by_word(values - words[word], word, len(words))
    out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-6)
    flat = out.reshape(-1)
    return flat / max(float(np.linalg.norm(flat)), 1e-6)
