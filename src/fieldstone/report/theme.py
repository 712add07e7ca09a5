"""How figures look: colours for a light and a dark page, and text that any file name survives.

A chart is drawn once per theme and lies on the colour of the page's cards; a figure on photos, or of points in the
colours of photos, is drawn once, on the dark ground of `LIGHTBOX`, which suits both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8


@dataclass(frozen=True)
class Theme:
    """Colours of one kind of figure."""

    name: str
    paper: str
    ink: str
    muted: str
    grid: str
    first: str
    second: str
    third: str
    good: str
    bad: str


LIGHT = Theme(
    "light", "#ffffff", "#1c2330", "#667085", "#e6e9ef", "#2f6fde", "#e07b12", "#8a55d7", "#12976a", "#d9363e"
)
DARK = Theme("dark", "#171b22", "#e6e9ef", "#98a2b3", "#2a303b", "#6ea3ff", "#f2a24a", "#b794f6", "#3ccb97", "#ff6b6f")
LIGHTBOX = Theme(
    "lightbox", "#14171d", "#eef0f4", "#a3adbd", "#2a303b", "#5db0ff", "#ffc24d", "#c8a6ff", "#4be3a4", "#ff5a5f"
)


def label(text: str, longest: int = 28) -> str:
    """The text as a figure can show it: one line, at most `longest` characters, none of them invisible.

    A long name loses its middle, because names of photos differ at their ends.
    """
    shown = "".join(c if c.isprintable() else "\N{WHITE SQUARE}" for c in text)
    if len(shown) <= longest:
        return shown
    head = (longest - 1) // 2
    return shown[:head] + "…" + shown[len(shown) - (longest - 1 - head) :]


def evenly(count: int, at_most: int) -> Int[np.ndarray, "k"]:
    """At most `at_most` indices below `count`, first and last included, evenly spaced."""
    if count <= at_most:
        return np.arange(count)
    return np.unique(np.round(np.linspace(0, count - 1, at_most)).astype(np.int64))


def readable_colors(rgb: UInt8[np.ndarray, "p 3"], theme: Theme) -> UInt8[np.ndarray, "p 3"]:
    """Colours, those that would vanish on the theme's ground moved towards grey."""
    colors = rgb / 255.0
    brightness = (colors @ np.array([0.2126, 0.7152, 0.0722]))[:, None]
    paper = int(theme.paper[1:3], 16) / 255.0
    vanishing = np.clip(1.0 - np.abs(brightness - paper) / 0.35, 0.0, 1.0)
    return np.round(255.0 * (colors + 0.6 * vanishing * (0.5 - colors))).astype(np.uint8)


def rgb_of(color: str) -> tuple[int, int, int]:
    """Red, green and blue of a hex colour, 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def mixed(color: str, other: str, share: float) -> str:
    """A hex colour moved by `share` towards another."""
    return "#" + "".join(f"{round(a + share * (b - a)):02x}" for a, b in zip(rgb_of(color), rgb_of(other), strict=True))


def luminance(color: str) -> float:
    """How bright a hex colour looks, 0 to 1."""
    return sum(w * v for w, v in zip((0.2126, 0.7152, 0.0722), rgb_of(color), strict=True)) / 255.0
