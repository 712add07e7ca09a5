"""What a figure holds, found by the name that it was drawn with and brought back into the units of its panel."""

from __future__ import annotations

import base64
import io
import re
import xml.etree.ElementTree as ET

import numpy as np
from PIL import Image

SVG = "{http://www.w3.org/2000/svg}"
PRECISION = 0.011
"""Page units: coordinates have two decimals, and both axes add up."""


def drawn(figure: str, name: str, panel: int | None = None) -> list[ET.Element]:
    """Every element with this name, in the whole figure or in one panel."""
    root = ET.fromstring(figure)
    return [e for e in (root if panel is None else panels(root)[panel]).iter() if e.get("class") == name]


def panels(root: ET.Element) -> list[ET.Element]:
    """Boxes that show data, in the order in which they were drawn."""
    return [e for e in root.iter(f"{SVG}svg") if e.get("class") == "panel"]


def positions(figure: str, name: str, panel: int = 0) -> np.ndarray:
    """Where the pieces of the one path with this name start (n, 2), in the panel's units."""
    (path,) = drawn(figure, name, panel)
    return in_panel(figure, _numbers(r"M(\S+) ([^A-Za-z]+?)(?=[A-Za-z]|$)", path.get("d", "")), panel)


def segments(figure: str, name: str, panel: int = 0) -> np.ndarray:
    """End points (n, 2, 2) of the one path of lines with this name, in the panel's units."""
    (path,) = drawn(figure, name, panel)
    ends = _numbers(r"M(\S+) ([^L]+)L(\S+) ([^M]+)", path.get("d", ""))
    return in_panel(figure, ends.reshape(-1, 2, 2), panel)


def vertices(path: ET.Element) -> np.ndarray:
    """Corners (n, 2) of a line, in page units."""
    return _numbers(r"[ML](\S+) ([^A-Za-z]+)", path.get("d", ""))


def centers(figure: str, name: str, panel: int = 0) -> np.ndarray:
    """Centres (n, 2) of the circles with this name, in the panel's units."""
    circles = drawn(figure, name, panel)
    return in_panel(figure, np.array([[float(e.get(k, "")) for k in ("cx", "cy")] for e in circles]), panel)


def in_panel(figure: str, on_page: np.ndarray, panel: int = 0) -> np.ndarray:
    """Positions on the page in the units of a panel with plain axes."""
    left, top, width, height, x0, x1, y0, y1 = borders(figure, panel)
    x = x0 + (on_page[..., 0] - left) / width * (x1 - x0)
    y = y1 + (on_page[..., 1] - top) / height * (y0 - y1)
    return np.stack([x, y], axis=-1)


def tolerance(figure: str, panel: int = 0) -> float:
    """How far apart two positions may be in a panel's units: what the decimals of the page leave open."""
    _, _, width, height, x0, x1, y0, y1 = borders(figure, panel)
    return PRECISION * max(abs(x1 - x0) / width, abs(y1 - y0) / height)


def borders(figure: str, panel: int) -> list[float]:
    """Left, top, width, height on the page; the values at the left, right, bottom and top border."""
    element = panels(ET.fromstring(figure))[panel]
    box = [float(element.get(key, "")) for key in ("x", "y", "width", "height")]
    return box + [float(v) for v in element.get("data-values", "").split()]


def words(figure: str, name: str = "title") -> list[str]:
    """The texts with this name."""
    return ["".join(e.itertext()) for e in drawn(figure, name)]


def pixels(picture: ET.Element) -> np.ndarray:
    """The pixels of a picture."""
    encoded = picture.get("href", "").split(",")[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"))


def _numbers(pattern: str, data: str) -> np.ndarray:
    found = re.findall(pattern, data)
    return np.array(found, dtype=np.float64).reshape(-1, re.compile(pattern).groups)
