"""Bad photos among good ones, and what is said of them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldstone.features.sift import SiftOptions
from fieldstone.io.workspace import Workspace
from fieldstone.pipeline.matching_options import MatchingOptions
from fieldstone.pipeline.material import match_photos

OPTIONS = MatchingOptions(sift=SiftOptions(max_features=1000), threads=2)


@pytest.fixture
def photos(house_photos, tmp_path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(house_photos, tmp_path / "photos"))


def matched(photos: Path, options: MatchingOptions = OPTIONS):
    return match_photos(photos, options, 0, lambda stage: None, Workspace())


def test_no_features_under_masks(photos, tmp_path):
    (tmp_path / "masks").mkdir()
    keep = np.zeros((240, 320), dtype=np.uint8)
    keep[:, :200] = 255
    for path in photos.iterdir():
        Image.fromarray(keep).save(tmp_path / "masks" / f"{path.name}.png")
    options = replace(OPTIONS, masks=tmp_path / "masks")
    graph = matched(photos, options).graph
    assert max(k[:, 0].max() for k in graph.keypoints) < 200.0
    workspace = Workspace(tmp_path / "units")
    for _ in range(2):
        again = match_photos(photos, options, 0, lambda stage: None, workspace).graph
        np.testing.assert_array_equal(again.keypoints[3], graph.keypoints[3])
    Image.fromarray(255 - keep).save(tmp_path / "masks" / "house_03.jpg.png")
    changed = match_photos(photos, options, 0, lambda stage: None, workspace).graph
    assert changed.keypoints[3][:, 0].min() >= 200.0
    np.testing.assert_array_equal(changed.keypoints[2], graph.keypoints[2])
