"""Cameras and points in space are drawn where they are, whatever the outliers."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.text import Text

from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.geometry.sim3 import Sim3
from fieldstone.mapping.textbook import TextbookOptions, map_textbook
from fieldstone.report.model_figures import (
    bundle_overlay_figure,
    four_poses_figure,
    from_above_figure,
    frustum_edges,
    in_front_of_both,
    perspective_figure,
    similarity_between,
    upright_frame,
    viewpoint,
)
from fieldstone.report.theme import DARK, LIGHT, drawn_pixels
from fieldstone.scene.alignment import transformed
from fieldstone.scene.reconstruction import Points, Reconstruction
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import Layout, SceneOptions, synthesize
from figure_artists import drawn, offsets, segments


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
    plan = (far.points.xyz @ upright_frame(far).T)[:, :2]
    np.testing.assert_allclose(np.sort(offsets(figure, "points"), axis=0), np.sort(plan, axis=0))
    (axes,) = figure.axes
    assert np.ptp(axes.get_xlim()) < 30
    assert np.ptp(axes.get_ylim()) < 30
    inside = axes.viewLim.padded(1e-9)
    assert all(inside.contains(x, y) for x, y in segments(figure, "frusta").reshape(-1, 2))
    box = axes.get_position().size * figure.get_size_inches()
    assert np.ptp(axes.get_xlim()) / box[0] == pytest.approx(np.ptp(axes.get_ylim()) / box[1])  # equal units
    assert {a.get_text() for a in drawn(figure, "name")} <= {v.name for v in truth.views}
    drawn_pixels(figure)  # places the names
    names = [Text.get_window_extent(a) for a in drawn(figure, "name")]  # without the line to the camera
    assert len(names) >= 3
    assert not any(a.overlaps(b) for k, a in enumerate(names) for b in names[:k])
    assert all(axes.bbox.x0 <= a.x0 and a.x1 <= axes.bbox.x1 for a in names)


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
    np.testing.assert_allclose(
        offsets(figure, "points"), (in_eye[:, :2] / in_eye[:, 2:])[np.argsort(-in_eye[:, 2], kind="stable")]
    )
    assert segments(figure, "frusta").shape == (5 * 8, 2, 2)


def test_four_poses_count_the_points_in_front_and_mark_the_chosen_one(run):
    initial = run.initial_pair
    figure = four_poses_figure(initial, ("a.png", "b.png"))
    assert len(figure.axes) == 4
    for k, axes in enumerate(figure.axes):
        front = in_front_of_both(initial.candidates[k], initial.points[k])
        assert front.sum() == initial.in_front[k]
        np.testing.assert_allclose(offsets(figure, "front", k), initial.points[k][front][:, [0, 2]])
        np.testing.assert_allclose(offsets(figure, "behind", k), initial.points[k][~front][:, [0, 2]])
        title = axes.get_title(loc="left")
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
    lengths = [bar.get_width() for bar in drawn(figure, "moves-1")][::-1]  # bars from top to bottom
    # One camera of five turned by 0.02 rad; the best common rotation takes a fifth of it.
    np.testing.assert_allclose(lengths, np.rad2deg([0.004, 0.004, 0.016, 0.004, 0.004]), rtol=1e-3)
    assert len(offsets(figure, "points-before")) == len(offsets(figure, "points-after")) == len(truth.points)


def test_small_and_empty_models_are_drawn():
    truth = truth_of()
    unregistered = tuple(type(v)(v.name, v.camera, None) for v in truth.views)
    one = Reconstruction(truth.cameras, truth.views[:1] + unregistered[1:], *nothing())
    none = Reconstruction(truth.cameras, unregistered, *nothing())
    for model in (one, none):
        for figure in (from_above_figure(model, theme=DARK), perspective_figure(model, theme=LIGHT)):
            drawn_pixels(figure)
