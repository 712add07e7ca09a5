"""Cameras and points in space are drawn where they are, whatever the outliers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from drawn_figures import borders, drawn, pixels, positions, segments, tolerance, words
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.geometry.sim3 import Sim3
from fieldstone.geometry.triangulation import in_front_of_both
from fieldstone.mapping.textbook import TextbookOptions, map_textbook
from fieldstone.report.model_figures import (
    NAME_SIZE,
    bundle_overlay_figure,
    four_poses_figure,
    from_above_figure,
    frustum_edges,
    perspective_figure,
    similarity_between,
    upright_frame,
    viewpoint,
)
from fieldstone.report.theme import LIGHT, LIGHTBOX
from fieldstone.scene.alignment import transformed
from fieldstone.scene.reconstruction import Points, Reconstruction
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import Layout, SceneOptions, synthesize


def truth_of(layout: Layout = "arc", **options) -> Reconstruction:
    return synthesize(
        SceneOptions(num_cameras=5, num_points=80, layout=layout, **options), np.random.default_rng(0)
    ).truth


@pytest.fixture(scope="module")
def run():
    scene = synthesize(
        SceneOptions(num_cameras=3, num_points=120, layout="arc", noise_px=0.5, outlier_share=0.2),
        np.random.default_rng(0),
    )
    camera_of_image = np.array([view.camera for view in scene.truth.views])
    return map_textbook(scene.graph, scene.truth.cameras, camera_of_image, TextbookOptions(), 0)


def test_frustum_edges_project_onto_the_corners_of_the_photo():
    truth = truth_of()
    camera, pose = truth.camera_of(1), truth.pose_of(1)
    edges = frustum_edges(camera, pose, 0.7)
    np.testing.assert_allclose(edges[:4, 0], np.broadcast_to(truth.camera_centers()[1], (4, 3)), atol=1e-12)
    corners = pose.apply(edges[:4, 1])
    np.testing.assert_allclose(corners[:, 2], 0.7)
    w, h = camera.width, camera.height
    np.testing.assert_allclose(image_from_cam(camera, corners), [[0, 0], [w, 0], [w, h], [0, h]], atol=1e-9)
    np.testing.assert_array_equal(edges[4:, 0], edges[:4, 1])
    np.testing.assert_array_equal(edges[4:, 1], np.roll(edges[:4, 1], -1, axis=0))


@pytest.mark.parametrize("layout", ["arc", "street", "ring"])
def test_upright_frame_finds_up_and_is_a_rotation(layout):
    right, forward, up = frame = upright_frame(truth_of(layout))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, forward), up, atol=1e-12)
    # These scenes have z up; the cameras of an arc all look down by some 27 deg, but none is rolled.
    assert np.rad2deg(np.arccos(up[2])) < 3.0


def test_from_above_draws_every_point_where_it_is_and_ignores_far_outliers():
    truth = truth_of()
    far = replace_points(truth, np.concatenate([truth.points.xyz, [[0.0, 1e4, 0.0], [-1e5, 0.0, 3.0]]]))
    figure = from_above_figure(far)
    left, _, width, height, x0, x1, y0, y1 = borders(figure, 0)
    assert 0 < x1 - x0 < 30
    assert 0 < y1 - y0 < 30
    assert (x1 - x0) / width == pytest.approx((y1 - y0) / height)  # equal units
    plan = (truth.points.xyz @ upright_frame(far).T)[:, :2]
    inside = plan[np.all((plan > [x0, y0]) & (plan < [x1, y1]), axis=1)]
    assert len(inside) > 0.8 * len(plan)
    assert_dots_at(cloud_of(figure), (inside - [x0, y1]) / [x1 - x0, y0 - y1])
    frusta = segments(figure, "frusta")
    assert frusta.shape == (5 * 8, 2, 2)
    assert np.all((frusta > [x0, y0]) & (frusta < [x1, y1]))
    names = [(float(e.get("x", "")), float(e.get("y", "")), "".join(e.itertext())) for e in drawn(figure, "name")]
    assert len(names) >= 3
    assert {name for _, _, name in names} <= {v.name for v in truth.views}
    for k, (x, y, name) in enumerate(names):
        half = 0.3 * NAME_SIZE * len(name)  # letters are some 0.6 of their size wide
        assert left <= x - half
        assert x + half <= left + width
        for x2, y2, name2 in names[:k]:
            assert abs(y - y2) >= NAME_SIZE or abs(x - x2) >= half + 0.3 * NAME_SIZE * len(name2)


def cloud_of(figure: str) -> np.ndarray:
    """The pixels of the cloud, as distances from the ground's colour."""
    (image,) = drawn(figure, "points")
    shown = pixels(image).astype(int)
    return np.abs(shown - [int(LIGHTBOX.paper[k : k + 2], 16) for k in (1, 3, 5)]).max(axis=2)


def assert_dots_at(cloud: np.ndarray, places: np.ndarray) -> None:
    """There is a dot at each place (in shares of the picture's width and height), and none elsewhere."""
    height, width = cloud.shape
    at = np.floor(places * [width, height]).astype(int)
    assert cloud[at[:, 1], at[:, 0]].min() > 40
    distance = KDTree(places * [width, height]).query(np.argwhere(cloud > 40)[:, ::-1] + 0.5)[0]
    assert distance.max() < 10  # pixels: the largest radius, and the border of dots whose centre is outside


def replace_points(model: Reconstruction, xyz: np.ndarray) -> Reconstruction:
    rgb = np.full((len(xyz), 3), 128, dtype=np.uint8)
    return Reconstruction(model.cameras, model.views, Points(xyz, rgb), model.observations)


def test_perspective_is_a_projection_that_shows_the_scene_from_behind_and_above():
    truth = truth_of()
    eye_from_world = viewpoint(truth)
    _, forward, up = upright_frame(truth)
    eye, target = eye_from_world.target_origin_in_source(), truth.points.xyz.mean(axis=0)
    assert (eye - target) @ forward < 0 < (eye - target) @ up
    figure = perspective_figure(truth)
    in_eye = eye_from_world.apply(truth.points.xyz)
    *_, x0, x1, y0, y1 = borders(figure, 0)
    places = (in_eye[:, :2] / in_eye[:, 2:] - [x0, y1]) / [x1 - x0, y0 - y1]
    assert_dots_at(cloud_of(figure), places[np.all((places > 0) & (places < 1), axis=1)])
    assert segments(figure, "frusta").shape == (5 * 8, 2, 2)


def test_four_poses_count_the_points_in_front_and_mark_the_chosen_one(run):
    initial = run.initial_pair
    figure = four_poses_figure(initial, ("a.png", "b.png"))
    titles = words(figure)
    assert len(titles) == 4
    assert len(drawn(figure, "chosen")) == 1
    for k, title in enumerate(titles):
        front = in_front_of_both(initial.candidates[k], initial.points[k])
        assert front.sum() == initial.in_front[k]
        for name, mask in (("front", front), ("behind", ~front)):
            points = initial.points[k][mask][:, [0, 2]]
            near = np.all(np.abs(points) < 100, axis=1)  # those far outside of the page are clipped
            np.testing.assert_allclose(positions(figure, name, k)[near], points[near], atol=tolerance(figure, k))
        assert f"{initial.in_front[k]} of {len(front)} in front" in title
        assert title.startswith("chosen") == (k == initial.chosen)


def test_similarity_between_undoes_any_change_of_frame_also_for_cameras_on_a_line():
    truth = truth_of("street")
    moved = transformed(truth, Sim3(2.5, exp(np.array([0.3, -1.0, 0.4])), np.array([4.0, -2.0, 1.0])))
    back = transformed(moved, similarity_between(moved, truth))
    np.testing.assert_allclose(back.camera_centers(), truth.camera_centers(), atol=1e-9)
    np.testing.assert_allclose(back.points.xyz, truth.points.xyz, atol=1e-9)
    with pytest.raises(ValueError, match="two common"):
        similarity_between(replace_points(truth, truth.points.xyz), Reconstruction(truth.cameras, (), *nothing()))


def nothing() -> tuple[Points, Observations]:
    return Points(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8)), Observations.empty()


def test_overlay_shows_how_far_each_camera_moved():
    truth = truth_of()
    views = list(truth.views)
    pose = truth.pose_of(2)
    turned = Rigid3(exp(np.array([0.0, 0.02, 0.0])) @ pose.R, exp(np.array([0.0, 0.02, 0.0])) @ pose.t)
    views[2] = type(views[2])(views[2].name, views[2].camera, turned)
    before = Reconstruction(truth.cameras, tuple(views), truth.points, truth.observations)
    figure = bundle_overlay_figure(before, truth)
    bars = drawn(figure, "moves-1")
    tops = [float(bar.get("y", "")) for bar in bars]
    assert tops == sorted(tops)
    lengths = np.array([float(bar.get("width", "")) for bar in bars])
    # One camera of five turned by 0.02 rad; the best common rotation takes a fifth of it.
    np.testing.assert_allclose(lengths / lengths[2], [0.25, 0.25, 1.0, 0.25, 0.25], rtol=1e-3)
    marks = [e for e in drawn(figure, "tick") if float(e.get("x", "")) >= float(bars[0].get("x", ""))]
    (zero, first), degrees = (float(e.get("x", "")) for e in marks[:2]), float("".join(marks[1].itertext()))
    assert lengths[2] / (first - zero) * degrees == pytest.approx(np.rad2deg(0.016), rel=1e-3)
    plan = (truth.points.xyz @ upright_frame(truth).T)[:, :2]
    np.testing.assert_allclose(positions(figure, "points-after"), plan, atol=tolerance(figure))
    assert len(positions(figure, "points-before")) == len(plan)


def test_small_and_empty_models_are_drawn():
    truth = truth_of()
    unregistered = tuple(type(v)(v.name, v.camera, None) for v in truth.views)
    one = Reconstruction(truth.cameras, truth.views[:1] + unregistered[1:], *nothing())
    none = Reconstruction(truth.cameras, unregistered, *nothing())
    for model in (one, none):
        for figure in (from_above_figure(model), perspective_figure(model, theme=LIGHT)):
            assert len(drawn(figure, "points")) == 1
