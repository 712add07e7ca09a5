"""The words that figures are drawn with: every function returns a piece of SVG, `page` makes an image of them.

Units are page units, x to the right and y down; a figure as wide as the report's text has 1,120 of them. An image
needs nothing outside itself: its pictures are inside, its fonts are those of the page that shows it, and it has no
style sheet and no script. A piece has a name (its `class`), by which it can be found.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import Literal

import numpy as np
from jaxtyping import Float

from fieldstone.report.theme import Theme, label

FONTS = "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, Liberation Sans, Arial, sans-serif"
TEXT_SIZE = 12.0
TITLE_SIZE = 13.5
LONGEST_TEXT = 160
FARTHEST = 1e5
"""Coordinates are clipped here, far outside of every page: renderers calculate with few digits."""

Anchor = Literal["start", "middle", "end"]
Points = Float[np.ndarray, "_ 2"] | Sequence[tuple[float, float]]


def page(width: float, height: float, theme: Theme, parts: Iterable[str]) -> str:
    """A whole image on the theme's ground."""
    ground = rectangle((0.0, 0.0, width, height), theme.paper, "ground")
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_n(width)} {_n(height)}" width="{_n(width)}" '
        f'height="{_n(height)}" font-family="{FONTS}" font-size="{_n(TEXT_SIZE)}" fill="none">'
        f"{ground}{''.join(parts)}</svg>\n"
    )


def text(
    at: tuple[float, float],
    words: str,
    color: str,
    *,
    size: float = TEXT_SIZE,
    anchor: Anchor = "start",
    weight: int = 400,
    turned_deg: float = 0.0,
    halo: str = "",
    name: str = "text",
) -> str:
    """One line of text with its base line at `at`, taken literally; `halo` is the colour of a rim around it."""
    place = f'x="{_n(at[0])}" y="{_n(at[1])}"'
    turn = f' transform="rotate({_n(turned_deg)} {_n(at[0])} {_n(at[1])})"' if turned_deg else ""
    rim = f' stroke="{halo}" stroke-width="3" stroke-linejoin="round" paint-order="stroke"' if halo else ""
    bold = f' font-weight="{weight}"' if weight != 400 else ""
    end = f' text-anchor="{anchor}"' if anchor != "start" else ""
    return (
        f'<text class="{name}" {place} font-size="{_n(size)}" fill="{color}"{end}{bold}{rim}{turn}>'
        f"{escape(label(words, LONGEST_TEXT))}</text>"
    )


def rectangle(
    box: tuple[float, float, float, float], color: str, name: str, *, outline: str = "", width: float = 0.0
) -> str:
    """A filled box (left, top, width, height), or an outlined one; `color` may be "none"."""
    rim = f' stroke="{outline}" stroke-width="{_n(width)}"' if outline else ""
    x, y, w, h = (_n(v) for v in box)
    return f'<rect class="{name}" x="{x}" y="{y}" width="{w}" height="{h}" fill="{color}"{rim}/>'


def dots(centers: Points, color: str, diameter: float, name: str, *, opacity: float = 1.0) -> str:
    """Round dots of one colour; where they overlap, they do not get darker. Those that are not finite are left out."""
    data = "".join(f"M{x:.6g} {y:.6g}h0" for x, y in _finite(centers))
    return (
        f'<path class="{name}" d="{data}" stroke="{color}" stroke-width="{_n(diameter)}" stroke-linecap="round"'
        f"{_opacity(opacity)}/>"
    )


def crosses(centers: Points, color: str, size: float, width: float, name: str) -> str:
    """Diagonal crosses in boxes of `size`; each begins at its centre."""
    h = _n(size / 2)
    arms = f"m-{h}-{h}l{_n(size)} {_n(size)}m-{_n(size)} 0l{_n(size)}-{_n(size)}"
    data = "".join(f"M{x:.6g} {y:.6g}{arms}" for x, y in _finite(centers))
    return f'<path class="{name}" d="{data}" stroke="{color}" stroke-width="{_n(width)}"/>'


def squares(centers: Points, color: str, size: float, width: float, name: str) -> str:
    """Outlines of squares; each begins at its centre."""
    h, s = _n(size / 2), _n(size)
    data = "".join(f"M{x:.6g} {y:.6g}m-{h}-{h}h{s}v{s}h-{s}z" for x, y in _finite(centers))
    return f'<path class="{name}" d="{data}" stroke="{color}" stroke-width="{_n(width)}"/>'


def circle(
    center: tuple[float, float], diameter: float, color: str, name: str, *, outline: str = "none", width: float = 0.0
) -> str:
    """A filled circle with an outline."""
    return (
        f'<circle class="{name}" cx="{center[0]:.6g}" cy="{center[1]:.6g}" r="{_n(diameter / 2)}" fill="{color}" '
        f'stroke="{outline}" stroke-width="{_n(width)}"/>'
    )


def segments(
    ends: Float[np.ndarray, "n 2 2"], color: str, width: float, name: str, *, opacity: float = 1.0
) -> str:  # fmt: skip
    """Straight lines of one colour."""
    rows = np.clip(ends.reshape(-1, 4), -FARTHEST, FARTHEST)
    rows = np.round(rows[np.all(np.isfinite(rows), axis=1)], 2) + 0.0
    data = "".join(f"M{a:.6g} {b:.6g}L{c:.6g} {d:.6g}" for a, b, c, d in rows.tolist())
    return f'<path class="{name}" d="{data}" stroke="{color}" stroke-width="{_n(width)}"{_opacity(opacity)}/>'


def polyline(points: Points, color: str, width: float, name: str) -> str:
    """A line through all points."""
    stroke = f'stroke="{color}" stroke-width="{_n(width)}" stroke-linejoin="round"'
    return f'<path class="{name}" d="{_path(points)}" {stroke}/>'


def polygon(points: Points, color: str, name: str, *, outline: str = "none", opacity: float = 1.0) -> str:
    """A filled polygon."""
    return f'<path class="{name}" d="{_path(points)}z" fill="{color}" stroke="{outline}"{_opacity(opacity)}/>'


def arrow(tail: Float[np.ndarray, "2"], tip: Float[np.ndarray, "2"], color: str, width: float, name: str) -> str:
    """A line with a head."""
    along = (tip - tail) / max(float(np.linalg.norm(tip - tail)), 1e-9)
    across = np.array([-along[1], along[0]])
    neck, half = tip - 5.0 * width * along, 2.0 * width * across
    shaft = segments(np.stack([tail, neck])[None], color, width, name)
    return shaft + polygon(np.stack([tip, neck + half, neck - half]), color, f"{name}-head")


def picture(image: bytes, box: tuple[float, float, float, float], name: str, *, blocky: bool = False) -> str:
    """An encoded PNG or JPEG, stretched over a box; `blocky` keeps its pixels apart."""
    kind = "png" if image.startswith(b"\x89PNG") else "jpeg"
    x, y, w, h = (_n(v) for v in box)
    sharp = ' image-rendering="pixelated"' if blocky else ""
    return (
        f'<image class="{name}" x="{x}" y="{y}" width="{w}" height="{h}" preserveAspectRatio="none"{sharp} '
        f'href="data:image/{kind};base64,{base64.b64encode(image).decode()}"/>'
    )


def defined(piece: str, key: str) -> str:
    """A piece that shows only where it is used, once or more often."""
    return f'<defs><g id="{key}">{piece}</g></defs>'


def used(key: str, at: tuple[float, float]) -> str:
    """A defined piece with its origin at `at`."""
    return f'<use href="#{key}" x="{_n(at[0])}" y="{_n(at[1])}"/>'


def _path(points: Points) -> str:
    return "M" + ("L".join(f"{x:.6g} {y:.6g}" for x, y in _finite(points)) or "0 0")


def _finite(points: Points) -> list[list[float]]:
    array = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    array = array[np.all(np.isfinite(array), axis=1)]
    return (np.round(np.clip(array, -FARTHEST, FARTHEST), 2) + 0.0).tolist()  # + 0.0: no "-0"


def _opacity(share: float) -> str:
    return f' opacity="{_n(share)}"' if share < 1.0 else ""


def _n(value: float) -> str:
    return f"{round(value, 3) + 0.0:.7g}"
