import cv2
import numpy as np
import pytest

from fieldstone.geometry.camera import (
    Camera,
    bearings_from_image,
    image_from_cam,
    image_from_cam_jacobian,
    rescale,
)
from fieldstone.geometry.camera_models import CAMERA_MODELS
from matchers import check_jacobian

PARAMS = {
    "SIMPLE_PINHOLE": [900.0, 640.5, 355.0],
    "PINHOLE": [900.0, 880.0, 640.5, 355.0],
    "SIMPLE_RADIAL": [900.0, 640.5, 355.0, -0.08],
    "RADIAL": [900.0, 640.5, 355.0, -0.12, 0.04],
    "OPENCV": [900.0, 880.0, 640.5, 355.0, -0.2, 0.06, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [600.0, 590.0, 640.5, 355.0, 0.02, -0.01, 3e-3, -4e-4],
    "FULL_OPENCV": [900.0, 880.0, 640.5, 355.0, 0.1, -0.05, 1e-3, -2e-3, 0.01, 0.2, -0.02, 0.004],
}


def camera_of(model: str) -> Camera:
    return Camera(model, 1280, 720, np.array(PARAMS[model]))


@pytest.fixture
def points() -> np.ndarray:
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 20, size=(200, 1))
    plane = np.concatenate([rng.uniform(-0.6, 0.6, size=(200, 2)), np.ones((200, 1))], axis=1)
    plane[0, :2] = 0.0  # the optical axis, where polar formulas divide by zero
    plane[1, :2] = 1e-9
    return plane * depth


def test_every_model_is_covered():
    assert PARAMS.keys() == CAMERA_MODELS.keys()


@pytest.mark.parametrize("model", PARAMS)
def test_jacobians_match_central_differences(model, points):
    camera = camera_of(model)
    pixels, J_point, J_params = image_from_cam_jacobian(camera, points)
    np.testing.assert_array_equal(pixels, image_from_cam(camera, points))
    check_jacobian(lambda d: image_from_cam(camera, points + d), J_point, size=3)
    scale = np.maximum(np.abs(camera.params), 1.0)
    check_jacobian(
        lambda d: image_from_cam(Camera(model, 1280, 720, camera.params + d * scale), points),
        J_params * scale,
        size=len(scale),
    )


@pytest.mark.parametrize("model", PARAMS)
def test_bearings_invert_projection(model, points):
    camera = camera_of(model)
    bearings = bearings_from_image(camera, image_from_cam(camera, points))
    expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(bearings, expected, atol=1e-10)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV"])
def test_projection_matches_opencv(model, points):
    camera = camera_of(model)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.calibration_matrix(), camera.coefficients)
    np.testing.assert_allclose(image_from_cam(camera, points), expected[:, 0], atol=1e-9)


def test_fisheye_matches_opencv(points):
    camera = camera_of("OPENCV_FISHEYE")
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros((3, 1)), np.zeros((3, 1)), camera.calibration_matrix(), camera.coefficients
    )
    np.testing.assert_allclose(image_from_cam(camera, points), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("model", PARAMS)
def test_all_models_match_colmap(model, points):
    pycolmap = pytest.importorskip("pycolmap")
    camera = camera_of(model)
    other = pycolmap.Camera(model=model, width=1280, height=720, params=camera.params)
    np.testing.assert_allclose(image_from_cam(camera, points), other.img_from_cam(points), atol=1e-9)
    assert CAMERA_MODELS[model].colmap_id == int(other.model)


def test_points_behind_the_camera_are_nan():
    pixels, J_point, _ = image_from_cam_jacobian(camera_of("PINHOLE"), np.array([[0.0, 0.0, -1.0], [1.0, 1.0, 0.0]]))
    assert np.all(np.isnan(pixels))
    assert np.all(np.isnan(J_point[:, 0, 0]))


def test_pixels_outside_the_lens_model_are_nan():
    # r (1 - r^2) never exceeds 0.385: a pixel further out has no ideal coordinates.
    camera = Camera("SIMPLE_RADIAL", 1000, 1000, np.array([500.0, 500.0, 500.0, -1.0]))
    bearings = bearings_from_image(camera, np.array([[990.0, 500.0], [510.0, 500.0]]))
    assert np.all(np.isnan(bearings[0]))
    assert np.all(np.isfinite(bearings[1]))


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("FANCY", [1.0], "unknown camera model"),
        ("PINHOLE", [1.0, 1.0, 0.0], "4 parameters"),
        ("PINHOLE", [0.0, 1.0, 0.0, 0.0], "positive"),
        ("SIMPLE_PINHOLE", [np.nan, 1.0, 0.0], "finite"),
    ],
)
def test_impossible_cameras_are_refused(model, params, message):
    with pytest.raises(ValueError, match=message):
        Camera(model, 10, 10, np.array(params))


def test_rescaled_camera_sees_the_same_rays(points):
    camera = camera_of("OPENCV")
    half = rescale(camera, 640, 240)
    np.testing.assert_allclose(
        image_from_cam(half, points), image_from_cam(camera, points) * np.array([0.5, 1 / 3]), atol=1e-9
    )
