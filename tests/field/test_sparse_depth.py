from dataclasses import replace

import numpy as np
import pytest

from fieldstone.field.base.projection import project_rays, projection_for, unproject_points
from fieldstone.field.base.ray_dataset import SeenPoints
from fieldstone.field.base.space import box_space, projective_space
from fieldstone.field.evidence.sparse_depth import seen_points, sparse_depth_rays
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from grid_scenes import CAMERA, FRAME, RADIUS, ball_photos, photographs

NOISE_PX = 0.8


def observed(pixels, views, camera, xyz):
    """A model of one camera in which every view sees every point."""
    point, view = (index.reshape(-1) for index in np.indices((len(xyz), len(views))))
    return Reconstruction(
        (camera,),
        tuple(View(f"{k}.png", 0, pose) for k, pose in enumerate(views)),
        Points(xyz, np.zeros((len(xyz), 3), np.uint8)),
        Observations(view, np.arange(len(point)), point, pixels[view, point]),
    )


def test_the_uncertainty_of_a_distance_is_its_spread():
    """Monte Carlo: points triangulated from noisy observations scatter along a ray as the covariance says."""
    rng = np.random.default_rng(0)
    camera = Camera("SIMPLE_PINHOLE", 640, 480, np.array([600.0, 320.0, 240.0]))
    up = np.array([0.0, -1, 0])
    views = [look_at(np.array([x, 0.0, -4.0]), np.zeros(3), up) for x in (-0.4, 0.0, 0.5)]
    true = np.tile(np.array([[0.1, -0.2, 0.3]]), (4000, 1))
    exact = np.stack([image_from_cam(camera, pose.apply(true)) for pose in views])
    pixels = exact + rng.normal(scale=NOISE_PX, size=exact.shape)
    # Linearised least squares: the optimum for small noise.
    centers = np.stack([pose.target_origin_in_source() for pose in views])
    step = 1e-6
    moved = true[:3] + step * np.eye(3)
    shifted = [image_from_cam(camera, pose.apply(moved)) for pose in views]
    J = np.concatenate([(shifted[k] - exact[k, :3]).T / step for k in range(3)])
    residual = (pixels - exact).transpose(1, 0, 2).reshape(len(true), -1)
    xyz = true + residual @ np.linalg.pinv(J).T
    model = observed(pixels, views, camera, xyz)
    found = seen_points(model, [0, 1, 2])
    for k in range(3):
        d = (true[0] - centers[k]) / np.linalg.norm(true[0] - centers[k])
        spread = ((xyz - true) @ d).std()
        # Each point's own reprojection error is a rough estimate of the noise, never below half a pixel.
        assert np.sqrt(np.mean(found[k].sigma ** 2)) == pytest.approx(spread, rel=0.25)


def test_points_that_rays_do_not_fix_are_left_out():
    camera = Camera("SIMPLE_PINHOLE", 640, 480, np.array([600.0, 320.0, 240.0]))
    views = [Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.01)]
    xyz = np.array([[0.0, 0, 0.2], [0.1, 0, 300.0]])
    pixels = np.stack([image_from_cam(camera, pose.apply(xyz)) for pose in views])
    (found,) = seen_points(observed(pixels, views, camera, xyz), [0])
    np.testing.assert_array_equal(found.xyz, xyz[:1])


def points_on_ball(rng, photos, count=40):
    """For each photo, points of the ball that face it."""
    seen = []
    for center in photos.posed.centers():
        p = rng.normal(size=(400, 3))
        p *= RADIUS / np.linalg.norm(p, axis=1, keepdims=True)
        facing = p[np.einsum("ni,ni->n", p, center - p) > 0.3][:count]
        seen.append(SeenPoints(facing, np.full(len(facing), 0.01)))
    return seen


def test_rays_to_points_meet_them_and_show_their_colour():
    photos = ball_photos(5)
    seen = points_on_ball(np.random.default_rng(1), photos)
    table, on_rays = sparse_depth_rays(photos, FRAME, seen, box_space())
    assert 0.8 * 200 < len(table.image) <= 200, "some lie where the photo is nearly transparent"
    directions = np.einsum("nij,nj->ni", table.rotations[table.image], table.bearings[table.bearing])
    reached = table.centers[table.image] + on_rays.distance[:, None] * directions
    for v in range(5):
        gaps = np.linalg.norm(reached[table.image == v, None] - seen[v].xyz[None], axis=2).min(axis=1)
        np.testing.assert_allclose(gaps, 0, atol=1e-5)
    # The ball is coloured by its normal; its photo is flat over a pixel of 1/14 units.
    normals = reached / RADIUS
    np.testing.assert_allclose(table.rgba[:, :3] / 255.0, 0.5 + 0.5 * normals, atol=0.15)
    np.testing.assert_allclose(on_rays.sigma, 0.01, rtol=1e-6)


def test_points_outside_of_masks_are_left_out():
    photos = ball_photos(2)
    seen = points_on_ball(np.random.default_rng(1), photos)
    keep = np.zeros((CAMERA.height, CAMERA.width), dtype=bool)
    table, _ = sparse_depth_rays(replace(photos, keep=(keep, None)), FRAME, seen, box_space())
    assert set(table.image.tolist()) == {1}


def test_distances_in_a_projective_space_are_those_of_the_marched_rays():
    rng = np.random.default_rng(2)
    pixels = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    poses = [Rigid3(np.eye(3), rng.normal(scale=0.1, size=3)) for _ in range(4)]
    photos = photographs(CAMERA, poses, [pixels] * 4)
    xyz = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), rng.uniform(3, 9, 50)])
    found = projection_for(photos.posed, FRAME, xyz)
    assert found is not None
    projection, _ = found
    seen = [SeenPoints(xyz, np.full(50, 0.05))] * 4
    table, on_rays = sparse_depth_rays(photos, FRAME, seen, projective_space(projection))
    d = np.einsum("nij,nj->ni", table.rotations[table.image], table.bearings[table.bearing]).astype(np.float64)
    o = table.centers[table.image].astype(np.float64)
    start, direction, _ = project_rays(projection, o, d)
    reached = unproject_points(projection, start + on_rays.distance[:, None] * direction)
    nearest = np.linalg.norm(reached[:, None] - xyz[None], axis=2).min(axis=1)
    np.testing.assert_allclose(nearest, 0, atol=2e-3)
