"""Photos that were reduced for detection: everything that is told is in pixels of the photos as they are."""

import re

import numpy as np
import pytest

from fieldstone.run.reconstruct import reconstruct
from fieldstone.run.scene import Scene
from fieldstone.scene.mapping_run import MappingRun

REDUCTION = 2.0


@pytest.fixture(scope="module")
def scene(house_photos) -> Scene:
    """The photos have 320 x 240 pixels."""
    return reconstruct(house_photos, max_image_size=round(320 / REDUCTION), covariance=True)


@pytest.fixture(scope="module")
def run(scene) -> MappingRun:
    """The story of the scene."""
    return scene.mapped.run


def test_notes_give_the_intrinsics_of_the_photos(scene):
    camera = scene.model.cameras[0]
    assert (camera.width, camera.height) == (320, 240)
    assert abs(camera.principal_point[0] - 160) < 20
    (note,) = [note for note in scene.notes if note.startswith("camera ")]
    numbers = note.partition(":")[2].partition(";")[0]
    told = re.findall(r"\w+ (-?[\d.]+(?:e-?\d+)?)", numbers)
    np.testing.assert_allclose(np.array(told, dtype=float), camera.params, rtol=1e-5)


def test_errors_are_in_pixels_of_the_photos(scene, run):
    """The predictions are as far off as the reprojections; sigma^2 is their squared sum over the degrees of freedom."""
    errors = scene.model.reprojection_errors()
    rms = float(np.sqrt(np.mean(errors**2)))
    after = np.concatenate([r.errors() for r in run.records if r.stage == "after BA"])
    assert float(np.sqrt(np.mean(after**2))) == pytest.approx(rms, rel=1e-9)
    assert run.uncertainty is not None
    model = scene.model
    camera_freedoms = 4
    freedoms = 2 * len(errors) - 6 * len(model.registered()) - 3 * len(model.points) - camera_freedoms + 7
    expected = np.sqrt(np.sum(errors**2) / freedoms)
    assert run.uncertainty.sigma_px == pytest.approx(expected, rel=0.01)


def test_thresholds_grow_with_the_reduction(scene, run):
    errors = scene.model.reprojection_errors()
    assert 4.0 < errors.max() <= 4.0 * REDUCTION
    assert all(f"{4 * REDUCTION:g} px" in drop.reason for drop in run.drops if "reprojection" in drop.reason)
