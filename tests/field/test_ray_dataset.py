from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, RenderedRays, in_world
from fieldstone.field.base.ray_dataset import (
    RayDataset,
    area_weights,
    blender_frame,
    default_background,
    frame_from_points,
    reduce_photos,
    split_every,
    training_rays,
)
from fieldstone.geometry import rotation
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.rays import pixel_centers, rays_from_view
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from grid_scenes import photographs


def simple_camera(width=6, height=4):
    return Camera("SIMPLE_PINHOLE", width, height, np.array([5.0, width / 2, height / 2]))


def random_pose(seed):
    rng = np.random.default_rng(seed)
    return Rigid3(rotation.exp(rng.standard_normal(3)), rng.standard_normal(3))


def random_photos(camera, channels=(4, 4, 4)):
    rng = np.random.default_rng(0)
    pixels = [rng.integers(0, 256, (camera.height, camera.width, c)).astype(np.uint8) for c in channels]
    return photographs(camera, [random_pose(seed) for seed in range(len(channels))], pixels)


def random_frame():
    rng = np.random.default_rng(5)
    sim3 = Sim3(0.3, rotation.exp(rng.standard_normal(3)), rng.standard_normal(3))
    return FieldFrame(sim3, 1.0, 4.0, np.array([0.2, 0.5, 0.9]))


def test_rays_of_the_table_pass_through_the_points_that_their_pixels_show():
    camera, frame = simple_camera(), random_frame()
    photos = random_photos(camera)
    table = training_rays(photos, frame)
    assert len(table) == 3 * 24
    for v in range(3):
        pose = photos.posed.pose_of(v)
        rays, colors = table.whole_image(v)
        # Points on each ray, moved back to the camera, fall on the pixel centres.
        points = rays.origins + 2.5 * rays.directions
        in_cam = pose.apply(frame.normalized_from_world.inverse().apply(points.astype(np.float64)))
        np.testing.assert_allclose(image_from_cam(camera, in_cam), pixel_centers(6, 4), atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(rays.directions, axis=1), 1.0, rtol=1e-6)
        np.testing.assert_allclose(colors.reshape(4, 6, 3), photos.composited(v, frame.background), rtol=1e-6)
        in_world_rays = frame.normalize(rays_from_view(camera, pose))
        np.testing.assert_allclose(rays.directions, in_world_rays.directions, atol=1e-6)
        np.testing.assert_allclose(rays.origins, in_world_rays.origins, atol=1e-5)
        np.testing.assert_allclose(rays.pixel_radius, in_world_rays.pixel_radius, rtol=1e-6)


def test_batches_are_rows_of_the_table():
    table = training_rays(random_photos(simple_camera()), random_frame())
    index = np.random.default_rng(0).integers(len(table), size=50)
    rays, colors = table.batch(index)
    whole = [table.whole_image(v) for v in range(3)]
    np.testing.assert_allclose(rays.origins, np.concatenate([r.origins for r, _ in whole])[index], rtol=1e-6)
    np.testing.assert_allclose(rays.directions, np.concatenate([r.directions for r, _ in whole])[index], atol=1e-6)
    np.testing.assert_array_equal(colors, np.concatenate([c for _, c in whole])[index])


def test_pixels_outside_of_the_lens_are_left_out():
    # r (1 + k r^2) with k = -1 reaches at most 0.385: the corners (|u| up to 0.6) have no ray.
    camera = Camera("SIMPLE_RADIAL", 6, 4, np.array([5.0, 3.0, 2.0, -1.0]))
    table = training_rays(random_photos(camera, channels=(4, 3)), blender_frame())
    centers = (pixel_centers(6, 4) - [3.0, 2.0]) / 5.0
    reached = np.linalg.norm(centers, axis=1) < np.sqrt(1 / 3) * 2 / 3
    assert 0 < np.count_nonzero(reached) < 24
    assert len(table) == 2 * np.count_nonzero(reached)
    rays, colors = table.whole_image(1)
    assert np.all(np.isfinite(rays.directions))
    assert len(colors) == np.count_nonzero(reached)


def test_background_of_photos_with_alpha_is_white():
    np.testing.assert_array_equal(default_background(random_photos(simple_camera(), channels=(3, 4))), np.ones(3))


def test_background_of_photos_without_alpha_is_their_mean_colour():
    photos = random_photos(simple_camera(), channels=(3, 3))
    expected = np.concatenate([pixels.reshape(-1, 3) for pixels in photos.pixels]).mean(axis=0) / 255
    np.testing.assert_allclose(default_background(photos), expected, rtol=1e-12)


def test_background_is_the_mean_of_what_masks_leave():
    photos = random_photos(simple_camera(), channels=(3,))
    (pixels,) = photos.pixels
    keep = np.zeros(pixels.shape[:2], dtype=bool)
    keep[1, 2] = keep[0, 1] = True
    expected = (pixels[1, 2].astype(float) + pixels[0, 1]) / 2 / 255
    np.testing.assert_allclose(default_background(replace(photos, keep=(keep,))), expected, rtol=1e-12)
    hidden = replace(photos, keep=(np.zeros_like(keep),))
    np.testing.assert_array_equal(default_background(hidden), np.full(3, 0.5))


@pytest.mark.parametrize(("size", "new_size"), [(6, 3), (7, 3), (5, 4), (5, 5), (9, 1)])
def test_area_weights_conserve_the_sum_and_the_centre_of_mass(size, new_size):
    weights = area_weights(size, new_size)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(weights.sum(axis=0), new_size / size, rtol=1e-12)
    centers = (np.arange(new_size) + 0.5) * size / new_size
    # Exact for linear images only where the old pixels are not cut; elsewhere off by less than a quarter pixel.
    np.testing.assert_allclose(weights @ (np.arange(size) + 0.5), centers, atol=0.25 if size % new_size else 1e-12)


def test_reducing_keeps_alpha_weighted_colour_and_the_view():
    camera = simple_camera(6, 4)
    pixels = np.zeros((4, 6, 4), dtype=np.uint8)
    pixels[:, ::2] = [200, 100, 40, 255]
    pixels[:, 1::2] = [7, 255, 9, 0]
    keep = np.ones((4, 6), dtype=bool)
    keep[3, 5] = False
    large = photographs(camera, [Rigid3.identity()], [pixels], keep=[keep])
    reduced = reduce_photos(large, 3)
    small, small_keep = reduced.pixels[0], reduced.keep[0]
    assert small.shape == (2, 3, 4)
    np.testing.assert_array_equal(small_keep, [[True, True, True], [True, True, False]])
    np.testing.assert_array_equal(small, np.broadcast_to([200, 100, 40, 128], (2, 3, 4)))
    small_camera = reduced.posed.camera_of(0)
    np.testing.assert_allclose(small_camera.params, camera.params / 2)
    # The mean of four rays' pixels is the pixel of the reduced camera.
    point = np.array([[0.3, -0.2, 1.0]])
    np.testing.assert_allclose(image_from_cam(small_camera, point), image_from_cam(camera, point) / 2)
    assert reduce_photos(large, 6).pixels[0] is pixels


def test_every_eighth_by_name_is_held_out():
    names = [f"{i:02d}" for i in range(17)]
    shuffled = [names[i] for i in np.random.default_rng(0).permutation(17)]
    train, test = split_every(shuffled)
    assert [shuffled[i] for i in test] == ["00", "08", "16"]
    assert sorted(shuffled[i] for i in train + test) == names
    assert split_every(["only"]) == ([0], [])


def test_frame_from_points_spans_the_points_but_not_the_outliers():
    rng = np.random.default_rng(0)
    xyz = np.concatenate([rng.uniform(-1, 1, (500, 3)) + [10, 0, 0], [[1000.0, 0, 0]]])
    centers = np.array([[10.0, 0, -6.0], [10.0, 6.0, 0.0]])
    views = tuple(View(f"{i}", 0, Rigid3(np.eye(3), -c)) for i, c in enumerate(centers)) + (View("none", 0, None),)
    point = np.repeat(np.arange(len(xyz)), 2)
    view = np.tile([0, 1], len(xyz))
    observations = Observations(view, np.zeros_like(view), point, np.zeros((len(view), 2)))
    model = Reconstruction(
        (simple_camera(),), views, Points(xyz, np.zeros((len(xyz), 3), dtype=np.uint8)), observations
    )
    frame = frame_from_points(model, np.zeros(3))
    to_world = 1 / frame.normalized_from_world.scale
    moved = frame.normalized_from_world.apply(xyz)
    assert np.mean(np.linalg.norm(moved, axis=1) <= 1.5) == pytest.approx(0.9, abs=0.01)
    distances = np.linalg.norm(xyz[:500, None] - centers, axis=2)
    assert frame.near * to_world < distances.min()
    assert distances.max() < frame.far * to_world < 20.0


def test_frame_from_points_needs_points():
    model = Reconstruction(
        (simple_camera(),),
        (View("0", 0, Rigid3.identity()),),
        Points(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)),
        Observations.empty(),
    )
    with pytest.raises(InputError, match="observations of points"):
        frame_from_points(model, np.zeros(3))


def test_renderer_in_the_world_scales_depth_back():
    frame = random_frame()
    camera = simple_camera()
    rays = rays_from_view(camera, random_pose(3))
    plane_normal, plane_offset = np.array([0.2, -0.5, 0.7]), 1.3

    def depth_of_plane(normalized_rays):
        n = len(normalized_rays)
        t = (plane_offset - normalized_rays.origins @ plane_normal) / (normalized_rays.directions @ plane_normal)
        return RenderedRays(np.zeros((n, 3)), t, np.ones(n))

    depth = in_world(depth_of_plane, frame)(rays).depth
    points_in_world = rays.origins + depth[:, None] * rays.directions
    np.testing.assert_allclose(frame.normalized_from_world.apply(points_in_world) @ plane_normal, plane_offset)


def test_bad_datasets_are_refused():
    photos = random_photos(simple_camera())
    none = photos.select([])
    with pytest.raises(InputError, match="no photo to train on"):
        RayDataset(none, none, blender_frame(), np.empty((0, 3)))
    with pytest.raises(ValueError, match="points of 2"):
        RayDataset(photos, none, blender_frame(), np.empty((0, 3)), seen=(None, None))
    with pytest.raises(ValueError, match="near < far"):
        FieldFrame(blender_frame().normalized_from_world, 3.0, 2.0, np.zeros(3))
