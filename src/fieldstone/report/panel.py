"""A box of a figure that shows data: where a value lies on the page, axes around it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Real

from fieldstone.report import svg
from fieldstone.report.theme import Theme

NUM_TICKS = 8
TITLE_RISE = 9.0
"""Page units between the top of a panel and the base line of its title."""


@dataclass(frozen=True)
class Panel:
    """A box of the page and the values at its borders."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float] = (0.0, 1.0)
    """Values at the left and the right border."""
    y: tuple[float, float] = (0.0, 1.0)
    """Values at the bottom and the top border."""
    log_x: bool = False
    log_y: bool = False

    @property
    def bottom(self) -> float:
        """Lower border on the page."""
        return self.top + self.height

    @property
    def right(self) -> float:
        """Right border on the page."""
        return self.left + self.width

    @property
    def box(self) -> tuple[float, float, float, float]:
        """(left, top, width, height)."""
        return self.left, self.top, self.width, self.height

    def place(self, values: Real[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Where values (x, y) lie on the page; borders map to borders."""
        across = _share(values[..., :1], self.x, self.log_x)
        upward = _share(values[..., 1:], self.y, self.log_y)
        return np.concatenate([self.left + across * self.width, self.bottom - upward * self.height], axis=-1)

    def clipped(self, parts: Iterable[str], name: str = "panel") -> str:
        """Pieces in page units, cut at the borders; the values at the borders stand beside them."""
        box = " ".join(f"{v:.9g}" for v in self.box)
        left, top, width, height = box.split()
        values = " ".join(repr(float(v)) for v in (*self.x, *self.y))
        return (
            f'<svg class="{name}" x="{left}" y="{top}" width="{width}" height="{height}" viewBox="{box}" '
            f'data-values="{values}">{"".join(parts)}</svg>'
        )


def title(panel: Panel, words: str, theme: Theme, *, size: float = svg.TITLE_SIZE) -> str:
    """The panel's title, above it at the left."""
    return svg.text((panel.left, panel.top - TITLE_RISE), words, theme.ink, size=size, name="title")


def axes(
    panel: Panel,
    theme: Theme,
    *,
    x: str = "",
    y: str = "",
    x_ticks: Sequence[float] | None = None,
    y_ticks: Sequence[float] | None = None,
    grid: bool = True,
    equal_units: bool = False,
) -> str:
    """Quiet axes at the left and the bottom: hairlines, muted numbers, and what they count.

    Args:
        x_ticks, y_ticks: Values to mark; None chooses round ones, an empty list marks none.
        equal_units: Chosen values have the same steps on both axes.
    """
    span = max(abs(b - a) for a, b in (panel.x, panel.y)) if equal_units else None
    at_x = ticks(panel.x, panel.log_x, span=span) if x_ticks is None else list(x_ticks)
    at_y = ticks(panel.y, panel.log_y, span=span) if y_ticks is None else list(y_ticks)
    columns = panel.place(np.array([[v, panel.y[0]] for v in at_x]).reshape(-1, 2))[:, 0].tolist()
    rows = panel.place(np.array([[panel.x[0], v] for v in at_y]).reshape(-1, 2))[:, 1].tolist()
    parts = []
    if grid:
        lines = [[[c, panel.top], [c, panel.bottom]] for c in columns]
        lines += [[[panel.left, r], [panel.right, r]] for r in rows]
        parts.append(svg.segments(np.array(lines).reshape(-1, 2, 2), theme.grid, 1.0, "grid"))
    corner = [(panel.left, panel.top), (panel.left, panel.bottom), (panel.right, panel.bottom)]
    parts.append(svg.polyline(corner, theme.grid, 1.2, "frame"))
    for value, column in zip(at_x, columns, strict=True):
        parts.append(_tick((column, panel.bottom + 16.0), value, theme, "middle"))
    for value, row in zip(at_y, rows, strict=True):
        parts.append(_tick((panel.left - 7.0, row + 4.0), value, theme, "end"))
    if x:
        center = panel.left + panel.width / 2
        parts.append(svg.text((center, panel.bottom + 35.0), x, theme.muted, anchor="middle"))
    if y:
        widest = max((len(_number(v)) for v in at_y), default=0)
        at = (panel.left - 16.0 - 6.6 * widest, panel.top + panel.height / 2)
        parts.append(svg.text(at, y, theme.muted, anchor="middle", turned_deg=-90.0))
    return "".join(parts)


def ticks(
    limits: tuple[float, float], log: bool = False, count: int = NUM_TICKS, *, span: float | None = None
) -> list[float]:
    """Round values between two limits: multiples of 1, 2 or 5 times a power of ten; powers of ten themselves if `log`.

    Args:
        count: At most so many steps, and more than a third of that, between the limits.
        span: Chooses the steps as for limits so far apart.
    """
    low, high = min(limits), max(limits)
    if log:
        exponents = np.arange(np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9) + 1)
        return [float(10.0**e) for e in exponents[:: max(1, -(-len(exponents) // count))]]
    if not high > low:
        return [low]
    least = (span or high - low) / count
    power = 10.0 ** np.floor(np.log10(least))
    step = power * next(m for m in (1, 2, 5, 10, 20) if m * power >= least * (1 - 1e-9))
    multiples = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
    return [float(f"{m * step:.12g}") + 0.0 for m in multiples]  # + 0.0: no "-0"


def whole_ticks(limits: tuple[float, float], count: int = NUM_TICKS) -> list[float]:
    """`ticks` that are integers."""
    return [v for v in ticks(limits, count=count) if v == round(v)]


def _tick(at: tuple[float, float], value: float, theme: Theme, anchor: svg.Anchor) -> str:
    return svg.text(at, _number(value), theme.muted, size=11.0, anchor=anchor, name="tick")


def _number(value: float) -> str:
    return f"{value + 0.0:.6g}".replace("-", "\N{MINUS SIGN}")


def _share(values: np.ndarray, limits: tuple[float, float], log: bool) -> np.ndarray:
    low, high = limits
    if log:
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log10(values)
        low, high = np.log10(low), np.log10(high)
    return (values - low) / (high - low)
