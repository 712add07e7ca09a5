"""Photos of the synthetic house, small and taken once."""

from pathlib import Path

import numpy as np
import pytest

from fieldstone.synthetic.photos import PhotoOptions, make_photos, write_photos

HOUSE = PhotoOptions(num_photos=6, width=320, height=240, arc_deg=60.0, samples_per_axis=1, texel=0.03)


@pytest.fixture(scope="session")
def house_photos(tmp_path_factory) -> Path:
    """Six photos, 320 x 240, of which every mapper makes one model. Copy them before changing them."""
    folder = tmp_path_factory.mktemp("house")
    write_photos(make_photos(HOUSE, np.random.default_rng(0)), folder, HOUSE)
    for path in folder.iterdir():
        if path.suffix != ".jpg":
            path.unlink()
    return folder
