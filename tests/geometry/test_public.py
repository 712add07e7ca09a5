"""What `fieldstone.geometry` offers; the other tests of this folder hold its functions to their oracles."""

import inspect
from pathlib import Path

import numpy as np
import pytest

import fieldstone.geometry as g


@pytest.mark.parametrize("name", dir(g))
def test_public_name_is_there_documented_and_tested(name):
    public = getattr(g, name)
    if inspect.isroutine(public) or inspect.isclass(public):
        assert public.__doc__, name
        assert not public.__doc__.startswith(f"{name}("), f"{name} has no docstring but dataclass's own"
    if inspect.isroutine(public):
        sources = [path.read_text() for path in Path(__file__).parent.glob("test_*.py")]
        assert any(f"{name}(" in source for source in sources)


def test_the_list_holds_what_is_wanted_of_a_geometry_package():
    assert {"Camera", "Rigid3", "Sim3", "rotation", "look_at", "image_from_cam", "triangulate_linear"} <= set(dir(g))


def test_pinhole_projects_as_its_matrix():
    K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    camera = g.pinhole(640, 480, K)
    points = np.array([[0.3, -0.2, 2.0], [-1.0, 0.4, 3.0]])
    x = points @ K.T
    np.testing.assert_allclose(g.image_from_cam(camera, points), x[:, :2] / x[:, 2:], rtol=1e-12)
    np.testing.assert_allclose(g.plane_from_image(camera, x[:, :2] / x[:, 2:]), points[:, :2] / points[:, 2:])


def test_in_front_of_both_is_the_sign_of_both_depths_and_refuses_what_is_not_finite():
    cam2_from_cam1 = g.Rigid3(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 5.0]))  # 5 ahead, looking back
    points = np.array([[0.0, 0, 2], [0.0, 0, 6], [0.0, 0, -1], [np.inf, 0, 1], [np.nan, 0, 1]])
    assert g.in_front_of_both(cam2_from_cam1, points).tolist() == [True, False, False, False, False]
