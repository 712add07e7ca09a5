"""Which photos hold a model together, and which are hardly held."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from fieldstone.scene.reconstruction import Reconstruction


def common_points(model: Reconstruction) -> Int[np.ndarray, "v v"]:
    """How many points two photos both see; on the diagonal, how many one sees."""
    observed = model.observations
    shape = (len(model.views), len(model.points))
    seen = csr_matrix((np.ones(len(observed), dtype=np.int32), (observed.view, observed.point)), shape=shape)
    return np.asarray((seen @ seen.T).todense(), dtype=np.int64)


def weakly_held(model: Reconstruction, min_points: int) -> list[int]:
    """Registered photos that see fewer points."""
    counts = np.bincount(model.observations.view, minlength=len(model.views))
    return [v for v in model.registered().tolist() if counts[v] < min_points]


def hinges(model: Reconstruction, min_points: int) -> dict[int, int]:
    """Photos without which the model falls apart, and how many photos the smaller part then has.

    Two photos hold each other where they see enough points together. A part of one photo does not count: it is weakly
    held, no more.
    """
    registered = model.registered()
    linked = common_points(model)[np.ix_(registered, registered)] >= min_points
    out = {}
    whole = _parts(linked)
    for k, view in enumerate(registered.tolist()):
        left = np.delete(np.delete(linked, k, axis=0), k, axis=1)
        parts = _parts(left)
        if len(parts) > len(whole) and parts[1] > 1:
            out[view] = int(parts[1])
    return out


def parts_of(model: Reconstruction, min_points: int) -> Int[np.ndarray, "k"]:
    """Numbers of photos that hold each other, the largest first."""
    registered = model.registered()
    return _parts(common_points(model)[np.ix_(registered, registered)] >= min_points)


def _parts(linked: np.ndarray) -> Int[np.ndarray, "k"]:
    _, label = connected_components(csr_matrix(linked), directed=False)
    return -np.sort(-np.bincount(label)) if len(label) else np.zeros(0, dtype=np.int64)
