"""How figures look: colours for a light and a dark page, text that any file name survives, encoding to bytes.

Figures are made with the object-oriented interface of matplotlib alone: no `pyplot`, no global settings. A chart is
drawn once per theme and lies on the colour of the page's cards; a figure on photos is drawn once, on the dark ground
of `LIGHTBOX`, which suits both.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ft2font import FT2Font
from PIL import Image

FONT = "DejaVu Sans"
"""Comes with matplotlib: a figure looks the same on every machine."""

CHART_DPI = 170
PHOTO_DPI = 125
JPEG_QUALITY = 80
PNG_LEVEL = 6
"""Higher levels take several times as long for a few percent."""
DRAWN_PX = 1000
"""Longer side in which figures show photos."""


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


def new_figure(width_in: float, height_in: float, theme: Theme, *, dpi: int = CHART_DPI) -> Figure:
    """An empty figure on the theme's ground."""
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, facecolor=theme.paper, edgecolor="none")
    FigureCanvasAgg(figure)
    return figure


def style_axes(axes: Axes, theme: Theme, *, title: str = "", x: str = "", y: str = "", grid: bool = True) -> None:
    """Quiet axes: hairlines, muted ticks, the title at the left."""
    axes.set_facecolor(theme.paper)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(theme.grid)
    axes.tick_params(colors=theme.muted, labelsize=8.5, length=3, width=0.8, labelfontfamily=FONT)
    if grid:
        axes.grid(True, color=theme.grid, linewidth=0.7)
        axes.set_axisbelow(True)
    if title:
        set_title(axes, title, theme)
    if x:
        axes.set_xlabel(label(x, 60), color=theme.muted, fontsize=9, family=FONT, parse_math=False)
    if y:
        axes.set_ylabel(label(y, 60), color=theme.muted, fontsize=9, family=FONT, parse_math=False)


def set_title(axes: Axes, text: str, theme: Theme, *, size: float = 10.0) -> None:
    """A title at the left, taken literally."""
    axes.set_title(
        label(text, 120), loc="left", color=theme.ink, fontsize=size, family=FONT, parse_math=False, pad=6
    )  # fmt: skip


def style_legend(axes: Axes, theme: Theme, *, location: Literal["best", "upper left"] = "best") -> None:
    """A legend without a frame."""
    axes.legend(
        loc=location, frameon=False, labelcolor=theme.ink, prop={"family": FONT, "size": 8.5}
    )  # fmt: skip


def label(text: str, longest: int = 28) -> str:
    """The text as a figure can show it: one line, at most `longest` characters, no glyph that the font lacks.

    A long name loses its middle, because names of photos differ at their ends.
    """
    shown = "".join(c if c.isprintable() and _has_glyph(c) else "\N{WHITE SQUARE}" for c in text)
    if len(shown) <= longest:
        return shown
    head = (longest - 1) // 2
    return shown[:head] + "…" + shown[len(shown) - (longest - 1 - head) :]


def evenly(count: int, at_most: int) -> Int[np.ndarray, "k"]:
    """At most `at_most` indices below `count`, first and last included, evenly spaced."""
    if count <= at_most:
        return np.arange(count)
    return np.unique(np.round(np.linspace(0, count - 1, at_most)).astype(np.int64))


def readable_colors(rgb: UInt8[np.ndarray, "p 3"], theme: Theme) -> Float[np.ndarray, "p 3"]:
    """Colours in [0, 1], those that would vanish on the theme's ground moved towards grey."""
    colors = rgb / 255.0
    luminance = (colors @ np.array([0.2126, 0.7152, 0.0722]))[:, None]
    paper = int(theme.paper[1:3], 16) / 255.0
    vanishing = np.clip(1.0 - np.abs(luminance - paper) / 0.35, 0.0, 1.0)
    return colors + 0.6 * vanishing * (0.5 - colors)


def encode_png(figure: Figure) -> bytes:
    """The drawn figure as PNG: the same bytes for the same figure, no date, no program name."""
    buffer = io.BytesIO()
    Image.fromarray(drawn_pixels(figure)).save(buffer, format="PNG", compress_level=PNG_LEVEL)
    return buffer.getvalue()


def encode_jpeg(pixels: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Pixels as JPEG with full colour resolution, because thin coloured lines are what a figure is about."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="JPEG", quality=JPEG_QUALITY, subsampling=0, optimize=True)
    return buffer.getvalue()


def drawn_pixels(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    """The figure's pixels, RGB."""
    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[:, :, :3])


def small(photo: UInt8[np.ndarray, "h w 3"], longest_px: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The photo, shrunk so that no side is longer than `longest_px`; never enlarged."""
    height, width = photo.shape[:2]
    scale = longest_px / max(height, width)
    if scale >= 1.0:
        return photo
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BOX, reducing_gap=3.0))


def mixed(color: str, other: str, share: float) -> str:
    """A hex colour moved by `share` towards another."""
    a, b = (np.array([int(c[k : k + 2], 16) for k in (1, 3, 5)]) for c in (color, other))
    return "#" + "".join(f"{round(v):02x}" for v in a + share * (b - a))


def luminance(color: str) -> float:
    """How bright a hex colour looks, 0 to 1."""
    return sum(w * int(color[k : k + 2], 16) for w, k in ((0.2126, 1), (0.7152, 3), (0.0722, 5))) / 255.0


@cache
def _font() -> FT2Font:
    return font_manager.get_font(font_manager.findfont(FONT))


def _has_glyph(character: str) -> bool:
    return _font().get_char_index(ord(character)) != 0
