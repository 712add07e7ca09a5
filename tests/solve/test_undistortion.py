import numpy as np

from fieldstone.geometry.camera import Camera, plane_from_image
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.solve.projection.undistortion import plane_from_images

COEFFICIENTS = np.array([-0.3, 0.05, 2e-3, -1e-3, 0.01, 0.02, -0.01, 0.005])


def test_every_model_matches_the_reference_also_outside_its_range():
    cameras = []
    for model, spec in CAMERA_MODELS.items():
        intrinsics = [800.0, 790.0][: spec.num_focal] + [310.0, 250.0]
        params = np.concatenate([intrinsics, COEFFICIENTS[: len(spec.coefficient_names)]])
        cameras.append(Camera(model, 640, 480, params))
    rng = np.random.default_rng(0)
    pixels = rng.uniform(-1500, 2500, size=(700, 2))
    pixels[:7] = [310.0, 250.0]
    camera = np.arange(700) % len(cameras)
    found = plane_from_images(cameras, camera, pixels)
    for c, one in enumerate(cameras):
        expected = plane_from_image(one, pixels[camera == c])
        np.testing.assert_allclose(found[camera == c], expected, rtol=1e-9, atol=1e-12)
    assert 0.02 < np.isnan(found[:, 0]).mean() < 0.9
