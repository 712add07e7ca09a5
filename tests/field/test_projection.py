import numpy as np
import pytest

from fieldstone.field.base.projection import (
    distance_along,
    project_points,
    project_rays,
    projection_for,
    unproject_points,
)
from fieldstone.field.base.space_numba import project_ray_numba
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import exp
from fieldstone.scene.rays import rays_from_view
from grid_scenes import CAMERA, FRAME, photographs

PIXELS = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)


def forward_photos(rng, count=6):
    """Cameras side by side that look along z, turned by a few degrees."""
    poses = [Rigid3(exp(rng.normal(scale=0.05, size=3)), rng.normal(scale=0.1, size=3)) for _ in range(count)]
    return photographs(CAMERA, poses, [PIXELS] * count).posed


@pytest.fixture
def space():
    rng = np.random.default_rng(0)
    photos = forward_photos(rng)
    points = np.column_stack([rng.uniform(-1, 1, (500, 2)), rng.uniform(2, 9, 500)])
    found = projection_for(photos, FRAME, points)
    assert found is not None
    return *found, photos


def test_points_of_a_ray_stay_on_its_projection(space):
    projection, _, photos = space
    rays = rays_from_view(CAMERA, photos.pose_of(0))
    start, direction, length = project_rays(projection, rays.origins, rays.directions)
    for t in (2.5, 7.0, 300.0):
        points = project_points(projection, rays.origins + t * rays.directions)
        along = np.einsum("ri,ri->r", points - start, direction)
        np.testing.assert_allclose(points, start + along[:, None] * direction, atol=1e-6)
        assert np.all(along < length)
        np.testing.assert_allclose(
            distance_along(projection, rays.origins, rays.directions, along / length), t, rtol=1e-4
        )


def test_points_come_back_from_the_projection(space):
    projection, _, _ = space
    ahead = np.array([[0.1, -0.3, 2.0], [1.0, 2.0, 7.0], [-3.0, 0.5, 90.0]])
    points = ahead @ projection.R.astype(np.float64) + projection.center
    np.testing.assert_allclose(unproject_points(projection, project_points(projection, points)), points, rtol=1e-4)


def test_the_box_holds_all_rays(space):
    projection, bounds, photos = space
    for v in range(len(photos)):
        rays = rays_from_view(CAMERA, photos.pose_of(v))
        start, direction, length = project_rays(projection, rays.origins, rays.directions)
        ends = np.concatenate([start, start + length[:, None] * direction])
        assert np.all(ends >= bounds[0] - 1e-6)
        assert np.all(ends <= bounds[1] + 1e-6)


def test_kernel_matches_reference(space):
    projection, _, photos = space
    rays = rays_from_view(CAMERA, photos.pose_of(1))
    directions = rays.directions.copy()
    directions[0] = -directions[0]
    start, expected, length = project_rays(projection, rays.origins, directions)
    o, d = rays.origins.astype(np.float32).reshape(-1), directions.astype(np.float32).reshape(-1)
    for ray in range(len(rays)):
        project_ray_numba(projection, o, d, ray)
    np.testing.assert_allclose(d.reshape(-1, 3), expected, atol=1e-5)
    ahead = length > 0
    assert not ahead[0]
    np.testing.assert_allclose(o.reshape(-1, 3)[ahead], start[ahead], atol=1e-4)


def test_cameras_around_an_object_get_no_projective_space():
    up = np.array([0.0, 0, 1])
    poses = [look_at(3 * np.array([np.cos(k), np.sin(k), 0.2]), np.zeros(3), up) for k in range(6)]
    photos = photographs(CAMERA, poses, [PIXELS] * 6).posed
    assert projection_for(photos, FRAME, np.random.default_rng(0).normal(size=(100, 3))) is None
    assert projection_for(photos, FRAME, np.empty((0, 3))) is None
