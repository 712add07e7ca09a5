import numpy as np
import pytest

from fieldstone.field.evidence.borders import kept_inside_borders
from grid_scenes import CAMERA

SHAPE = (CAMERA.height, CAMERA.width, 3)


def photos(count, wedge, rng=None):
    """Photos of noise with black where the wedge is, each with a dark patch of its own."""
    rng = rng or np.random.default_rng(0)
    out = []
    for k in range(count):
        pixels = rng.integers(20, 255, SHAPE, dtype=np.uint8)
        pixels[:5, 5 * k : 5 * k + 5] = 0
        pixels[15:18, 20:24] = 0
        pixels[wedge] = rng.integers(0, 5, (np.count_nonzero(wedge), 3))
        out.append(pixels)
    return out


def wedge_of(width):
    row, column = np.indices(SHAPE[:2])
    return column < width * np.abs(row / SHAPE[0] - 0.5) * 2


def test_the_border_that_all_photos_share_is_found():
    wedge = wedge_of(5)
    keep = kept_inside_borders(photos(4, wedge))
    assert keep is not None
    assert not keep[wedge].any()
    # Two pixels beside it go too; what is dark in one photo alone, or inside of all of them, stays.
    assert keep[:, 8:].all()


@pytest.mark.parametrize(("count", "width"), [(2, 5), (4, 0), (4, 30)])
def test_few_photos_no_border_and_dark_scenes_keep_everything(count, width):
    assert kept_inside_borders(photos(count, wedge_of(width))) is None
