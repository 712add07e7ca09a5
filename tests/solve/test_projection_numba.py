import numpy as np
import pytest

from fieldstone.geometry.camera import Camera, image_from_cam_jacobian
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.solve.projection.projection_numba import MAX_CAMERA_PARAMS, image_from_cam_numba, robust_numba
from fieldstone.solve.robust.loss import cauchy, huber, soft_l1, trivial

COEFFICIENTS = np.array([-0.1, 0.03, 2e-3, -1e-3, 0.01, 0.02, -0.01, 0.005])


@pytest.mark.parametrize("kernel", [image_from_cam_numba, image_from_cam_numba.py_func])
@pytest.mark.parametrize("model", list(CAMERA_MODELS))
def test_projection_and_derivatives_match_the_reference(model, kernel):
    spec = CAMERA_MODELS[model]
    intrinsics = [800.0, 790.0][: spec.num_focal] + [310.0, 250.0]
    params = np.concatenate([intrinsics, COEFFICIENTS[: len(spec.coefficient_names)]])
    camera = Camera(model, 640, 480, params)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-1, 1, size=(20, 2)), rng.uniform(0.5, 3, size=(20, 1))], axis=1)
    points[0, :2] = 0.0
    points[1] = [1e-9, 0.0, 1.0]
    pixels, J_point, J_params = image_from_cam_jacobian(camera, points)
    padded = np.concatenate([params, np.zeros(MAX_CAMERA_PARAMS - len(params))])
    J, J_p, J_k = np.empty((2, 3)), np.zeros((2, MAX_CAMERA_PARAMS)), np.zeros((2, 8))
    for k, (x, y, z) in enumerate(points):
        pixel = kernel(spec.colmap_id, padded, x, y, z, J, J_p, J_k)
        np.testing.assert_allclose(pixel, pixels[k], rtol=1e-12)
        np.testing.assert_allclose(J, J_point[k], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(J_p[:, : len(params)], J_params[k], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("number", "loss"), list(enumerate([trivial(), huber(1.5), soft_l1(1.5), cauchy(1.5)])))
def test_robust_losses_match_the_reference(number, loss):
    s = np.concatenate([[0.0], np.geomspace(1e-8, 1e6, 50)])
    rho, weight = loss(s)
    for k in range(len(s)):
        np.testing.assert_allclose(robust_numba(number, 1.5**2, s[k]), (rho[k], weight[k]), rtol=1e-12)
