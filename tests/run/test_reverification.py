from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.camera import Camera
from fieldstone.mapping.automatic import AutomaticOptions, register
from fieldstone.mapping.model.calibration import FOCAL_SIGMA
from fieldstone.run.map_photos import map_photos
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photos_to_graph import MatchedPhotos
from fieldstone.run.matching.reverification import with_cameras_of_models
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near

FOCAL = 1600.0
ONE_CAMERA = np.zeros(8, dtype=np.int64)
OPTIONS, MAPPING = MatchingOptions(threads=1), AutomaticOptions()


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    camera = Camera("SIMPLE_PINHOLE", 1000, 750, np.array([FOCAL, 500.0, 375.0]))
    options = SceneOptions(num_cameras=8, num_points=400, layout="arc", noise_px=0.3, camera=camera)
    return synthesize(options, np.random.default_rng(0))


def matched(scene: SyntheticScene, focal: float) -> MatchedPhotos:
    """The photos as they would be verified with a focal length that somebody guessed."""
    cameras = tuple(replace(camera, params=np.array([focal, 500.0, 375.0])) for camera in scene.truth.cameras)
    graph = verify_pairs(scene.graph, cameras, ONE_CAMERA, OPTIONS.two_view, 0, 1)
    return MatchedPhotos(graph, cameras, ONE_CAMERA, np.array([FOCAL_SIGMA]), lambda name: None, (), {})


def test_pairs_are_verified_with_the_focal_length_that_a_model_found(scene):
    wrong, right = matched(scene, FOCAL / 3), matched(scene, FOCAL)
    models = register(right.graph, right.cameras, ONE_CAMERA, right.focal_sigma, MAPPING, 0)
    again = with_cameras_of_models(wrong, models, OPTIONS, 0)
    assert again is not None
    np.testing.assert_allclose(again.cameras[0].params, [FOCAL, 500.0, 375.0], rtol=0.01)
    total = sum(len(rows) for rows in again.graph.matches.values())
    agree = sum(int(two_view.inliers.sum()) for two_view in again.graph.two_views.values())
    assert agree > 0.98 * total
    known = replace(wrong, focal_sigma=np.zeros(1))
    assert with_cameras_of_models(known, models, OPTIONS, 0) is None
    assert with_cameras_of_models(right, models, OPTIONS, 0) is None
    assert with_cameras_of_models(wrong, [], OPTIONS, 0) is None


def test_a_focal_length_that_is_far_off_costs_no_photo(scene):
    run = map_photos(matched(scene, FOCAL / 4), OPTIONS, MAPPING, 0)
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.3, relative_distance=0.01)
