import numpy as np

from fieldstone.field.base.radiance_field import RenderedRays, surface_depth
from fieldstone.geometry import rotation
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.rendering import views
from fieldstone.rendering.views import (
    RenderedView,
    confidence_image,
    depth_image,
    normal_image,
    progressive_views,
    render_view,
)


def render_ball(rays):
    """An opaque ball of radius 1 at the origin, coloured by its normal."""
    b = np.sum(rays.origins * rays.directions, axis=1)
    discriminant = b**2 - np.sum(rays.origins**2, axis=1) + 1
    t = -b - np.sqrt(np.maximum(discriminant, 0))
    hit = (discriminant > 0) & (t > 0)
    normals = rays.origins + t[:, None] * rays.directions
    return RenderedRays(np.where(hit[:, None], 0.5 + 0.5 * normals, 0.0), np.where(hit, t, 9.0), hit.astype(float))


def test_view_of_a_ball():
    camera = Camera("PINHOLE", 40, 30, np.array([35.0, 35.0, 19.0, 14.0]))
    pose = Rigid3(rotation.exp(np.array([0.1, -0.2, 0.3])), np.array([0.2, -0.1, 4.0]))
    view = render_view(render_ball, camera, pose, rays_at_once=37)
    assert view.rgb.shape == (30, 40, 3)
    # The centre of the ball is seen where the camera projects it, and its outline is the expected ellipse.
    row, column = np.nonzero(view.opacity)
    center = image_from_cam(camera, pose.t[None])[0]
    np.testing.assert_allclose([column.mean() + 0.5, row.mean() + 0.5], center, atol=0.3)
    # The cone around the ball: half angle asin(1 / distance), of area pi f^2 tan^2 a near the optical axis.
    distance = np.linalg.norm(pose.t)
    area = np.pi * 35**2 / (distance**2 - 1)
    assert abs(len(row) / area - 1) < 0.03
    nearest = view.depth[view.opacity > 0].min()
    assert distance - 1 <= nearest < distance - 1 + 0.01


def test_progressive_views_render_every_pixel_once_and_end_in_the_view():
    camera = Camera("PINHOLE", 43, 30, np.array([35.0, 35.0, 19.0, 14.0]))
    pose = Rigid3(rotation.exp(np.array([0.1, -0.2, 0.3])), np.array([0.2, -0.1, 4.0]))
    counts = []

    def counted(rays):
        counts.append(len(rays))
        return render_ball(rays)

    whole = render_view(render_ball, camera, pose)
    found = []
    for view in progressive_views(counted, camera, pose):
        assert view.depth.shape == (30, 43)
        found.append(view)
    assert counts[0] == 4 * 6
    assert sum(counts) == 30 * 43
    for name in ("rgb", "depth", "opacity"):
        np.testing.assert_array_equal(getattr(found[-1], name), getattr(whole, name))
        # A block of the coarsest view is the pixel in its middle, also where the photo cuts the block.
        coarse, fine = getattr(found[0], name), getattr(whole, name)
        assert np.all(coarse[8:16, 16:24] == fine[12, 20])
        assert np.all(coarse[24:, 40:] == fine[28, 42])
    errors = [np.abs(view.rgb - whole.rgb).mean() for view in found]
    assert np.all(np.diff(errors) < 0)


def test_pixels_outside_of_the_lens_are_empty():
    camera = Camera("SIMPLE_RADIAL", 6, 4, np.array([5.0, 3.0, 2.0, -1.0]))
    view = render_view(render_ball, camera, Rigid3(np.eye(3), np.array([0.0, 0, 1.5])))
    assert view.opacity[0, 0] == 0
    assert view.depth[0, 0] == 0
    assert view.opacity[2, 3] == 1
    assert np.all(np.isfinite(view.rgb))


def test_normals_of_a_ball_are_those_of_its_surface():
    camera = Camera("PINHOLE", 80, 60, np.array([90.0, 90.0, 40.0, 30.0]))
    pose = Rigid3(rotation.exp(np.array([0.1, -0.2, 0.3])), np.array([0.2, -0.1, 4.0]))
    view = render_view(render_ball, camera, pose)
    found = normal_image(view, camera) * 2 - 1
    # The ball is coloured by its normal in the world; in the camera, OpenGL axes turn y and z around.
    expected = (2 * view.rgb - 1) @ pose.R.T * [1, -1, -1]
    inner = (view.opacity > 0) & (expected[:, :, 2] > 0.75)
    # Away from the outline, where a difference over two pixels takes in the background.
    assert np.abs(found - expected)[inner].max() < 0.03
    assert np.all(found[view.opacity == 0] == -1)


def test_depth_is_bright_where_it_is_near():
    depth = np.array([[2.0, 4.0, 8.0, 3.0]])
    view = RenderedView(np.zeros((1, 4, 3)), depth, np.array([[1.0, 1, 1, 0]]))
    # Linear in 1 / depth from 1 at 2 to 0 at 8; nothing is seen at the last pixel.
    np.testing.assert_allclose(depth_image(view, 2.0, 8.0)[0, :, 0], [1.0, 1 / 3, 0.0, 0.0])


def test_confidence_counts_the_photos_that_see_a_point_from_the_same_side():
    camera = Camera("PINHOLE", 8, 6, np.array([8.0, 8.0, 4.0, 3.0]))
    here, opposite = Rigid3.identity(), Rigid3(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 10.0]))
    aside = Rigid3(np.eye(3), np.array([-100.0, 0.0, 0.0]))
    rays = views.rays_from_view(camera, here)
    wall = (5.0 / rays.directions[:, 2]).reshape(6, 8)
    opacity = np.full((6, 8), 0.8)
    # A fifth of the light passes and counts as ending at 9.
    view = RenderedView(np.zeros((6, 8, 3)), 0.8 * wall + 0.2 * 9.0, opacity)
    for photos, share in (
        ([], 0.0),
        ([here], 0.0),
        ([here, opposite, aside], 0.0),
        ([here] * 2, 0.5),
        ([here, here, here, opposite], 0.75),
    ):
        found = confidence_image(view, camera, here, [(camera, pose) for pose in photos], 9.0)
        np.testing.assert_allclose(found, 0.8 * share, atol=1e-12)
    # A photo moved by half its width sees half of the wall: 2.5 units are 4 pixels at 8 pixels focal length, depth 5.
    half = Rigid3(np.eye(3), np.array([-2.5, 0.0, 0.0]))
    found = confidence_image(view, camera, here, [(camera, here), (camera, half)], 9.0)[:, :, 0]
    np.testing.assert_allclose(found[:, :4], 0.0)
    np.testing.assert_allclose(found[:, 4:], 0.4)


def test_the_surface_is_where_the_light_that_ends_has_ended():
    """A sheet at 3 that stops 80 % of the light before a background at 50; through another, most of it passes."""
    opacity = np.array([[0.8, 0.3, 1.0]])
    depth = opacity * 3.0 + (1 - opacity) * 50.0
    np.testing.assert_allclose(surface_depth(depth, opacity, 50.0), [[3.0, np.inf, 3.0]])
