import numpy as np
import pytest

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.lens import border_angles, corner_radius, is_invertible, sees_like_a_fisheye

WIDTH, HEIGHT = 800, 600  # half the diagonal is 500


def radial(k: float, f: float = 500.0) -> Camera:
    return Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([f, 400.0, 300.0, k]))


def fisheye(f: float, *k: float) -> Camera:
    return Camera("OPENCV_FISHEYE", WIDTH, HEIGHT, np.array([f, f, 400.0, 300.0, *k]))


def test_angles_of_lenses_in_closed_form():
    """Perspective r = f tan(theta), equidistant r = f theta; corners, and middles of the sides between them."""
    radii = np.array([500, 300, 500, 400, 500, 300, 500, 400]) / 500.0
    angles, found = border_angles(radial(0.0))
    np.testing.assert_allclose(found, radii, rtol=1e-12)
    np.testing.assert_allclose(angles, np.arctan(radii), atol=1e-5)  # chords of the curve between 500 angles
    np.testing.assert_allclose(border_angles(fisheye(500.0, 0, 0, 0, 0))[0], radii, atol=1e-5)
    assert corner_radius(radial(0.0)) == pytest.approx(1.0)


@pytest.mark.parametrize("turn", [0.8, 0.95, 1.05, 1.3])
def test_a_barrel_that_turns_back_inside_the_photo_is_no_lens(turn):
    """r + k r^3 turns at r = (-3 k)^-1/2, where it is two thirds of that: `turn` times the corner's radius here."""
    camera = radial(-((2.0 / 3.0 / turn) ** 2) / 3.0)
    assert is_invertible(camera, beyond=1.0) == (turn > 1.0)
    assert is_invertible(camera, beyond=1.1) == (turn > 1.1)


@pytest.mark.parametrize("k", [-0.05, 0.0, 0.5])
def test_ordinary_lenses_are_invertible(k):
    assert is_invertible(radial(k))


def test_a_lens_that_sees_behind_itself_grows_as_far_as_cameras_see():
    """At 1.2 f its corners are at 69 degrees, at f / 2 at 115: beyond the plane z = 0, and fine until there."""
    for f in (420.0, 250.0):
        assert is_invertible(fisheye(f, 0, 0, 0, 0))
        assert sees_like_a_fisheye(fisheye(f, 0, 0, 0, 0))


def test_a_perspective_lens_written_as_a_fisheye_is_none():
    """tan(theta) = theta + theta^3 / 3 + 2 theta^5 / 15 + 17 theta^7 / 315 + 62 theta^9 / 2835 + ..."""
    series = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
    assert not sees_like_a_fisheye(fisheye(300.0, *series))  # 59 degrees, but not at the radius of a fisheye
    assert not sees_like_a_fisheye(fisheye(700.0, 0, 0, 0, 0))  # the radius, but 41 degrees
    stereographic = (1 / 12, 1 / 120, 17 / 20160, 31 / 362880)  # 2 tan(theta / 2)
    assert sees_like_a_fisheye(fisheye(300.0, *stereographic))
