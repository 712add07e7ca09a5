"""What a figure holds, found by the id that it was drawn with."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure


def drawn(figure: Figure, gid: str, axes: int | None = None) -> list[Any]:
    """Every artist with this id, in all axes or in one."""
    chosen = figure.axes if axes is None else [figure.axes[axes]]
    return [artist for a in chosen for artist in a.get_children() if artist.get_gid() == gid]


def offsets(figure: Figure, gid: str, axes: int | None = None) -> np.ndarray:
    """Positions (n, 2) of the one scatter plot with this id."""
    (points,) = drawn(figure, gid, axes)
    return np.asarray(points.get_offsets())


def segments(figure: Figure, gid: str, axes: int | None = None) -> np.ndarray:
    """End points (n, 2, 2) of the one collection of lines with this id."""
    (lines,) = drawn(figure, gid, axes)
    return np.array([np.asarray(s) for s in lines.get_segments()]).reshape(-1, 2, 2)
