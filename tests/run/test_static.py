"""Photos with something that does not move with the scene, from pixels to poses."""

from itertools import combinations

import cv2
import numpy as np
import pytest

from fieldstone.geometry.rotation import angle_between
from fieldstone.io.images.photos import read_photo, write_photo
from fieldstone.records.mapping import RunRecord
from fieldstone.run.reconstruct import reconstruct
from fieldstone.scene.reconstruction import Reconstruction

WORDS = ("2026-11-30 12:00", "48.137 N 11.575 E", "57 KM/H  CAM 2")


def with_bar(pixels):
    """A bar of text over the lower quarter."""
    out = pixels.copy()
    rows = len(out) // 4
    out[-rows:] = 20
    for k, line in enumerate(WORDS):
        at = (5, len(out) - rows + 16 + 18 * k)
        cv2.putText(out, line, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (230, 230, 210), 1, cv2.LINE_AA)
    return out


def result(folder) -> tuple[Reconstruction, RunRecord]:
    scene = reconstruct(folder, threads=1)
    assert scene.record is not None
    return scene.models[0], scene.record


@pytest.fixture(scope="module")
def barred(house_photos, tmp_path_factory):
    folder = tmp_path_factory.mktemp("barred")
    for path in house_photos.iterdir():
        write_photo(folder / path.name, with_bar(read_photo(path).rgb))
    return folder


def test_a_bar_of_text_changes_no_pose(house_photos, barred):
    (plain, record), (found, barred_record) = result(house_photos), result(barred)
    assert list(plain.registered()) == list(found.registered()) == list(range(6))
    for i, j in combinations(range(6), 2):
        relative, true = (model.pose_of(j).R @ model.pose_of(i).R.T for model in (found, plain))
        assert np.rad2deg(angle_between(relative[None], true[None]))[0] < 0.5
    assert any("does not move with the scene" in note for note in barred_record.notes)
    assert not any("does not move with the scene" in note for note in record.notes)
