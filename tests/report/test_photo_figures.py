"""What is drawn on photos lies where geometry says."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from drawn_figures import SVG, centers, drawn, in_panel, pixels, positions, segments, tolerance, vertices, words
from fieldstone.geometry.camera import Camera
from fieldstone.report.photo_figures import (
    distance_to_curves,
    epipolar_curves,
    epipolar_figure,
    epipole,
    essential_of,
    magnification,
    matches_figure,
    reprojections_figure,
)
from fieldstone.report.theme import label
from fieldstone.scene.mapping_run import StageRecord
from fieldstone.scene.match_graph import TwoView
from fieldstone.synthetic.scenes import SceneOptions, synthesize

CAMERAS = {
    "PINHOLE": [700.0, 690.0, 330.0, 236.0],
    "OPENCV": [600.0, 610.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002],
    "OPENCV_FISHEYE": [300.0, 300.0, 320.0, 240.0, 0.02, -0.01, 0.002, 0.0],
}


def scene_of(model: str = "PINHOLE", **options):
    camera = Camera(model, 640, 480, np.array(CAMERAS[model]))
    scene = synthesize(
        SceneOptions(num_cameras=3, num_points=60, layout="arc", camera=camera, **options), np.random.default_rng(0)
    )
    return scene.verified_graph(), scene.truth, (camera, camera)


def distance_to_polyline(point: np.ndarray, curve: np.ndarray) -> float:
    a, b = curve[:-1], curve[1:]
    along = np.clip(np.sum((point - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
    return float(np.linalg.norm(a + along[:, None] * (b - a) - point, axis=1).min())


@pytest.mark.parametrize("model", CAMERAS)
def test_epipolar_curves_pass_through_the_matching_points(model):
    graph, _, cameras = scene_of(model)
    E = essential_of(graph, (0, 1), cameras)
    pixels1, pixels2 = graph.matched_pixels((0, 1))
    curves = epipolar_curves(E, cameras, pixels1)
    assert len(curves) == len(pixels1) > 20
    assert max(distance_to_polyline(p, c) for p, c in zip(pixels2, curves, strict=True)) < 0.05
    assert distance_to_curves(E, cameras, pixels1, pixels2).max() < 1e-6


def test_epipolar_curves_of_a_pinhole_camera_are_straight_and_end_at_the_border():
    graph, _, cameras = scene_of()
    pixels1, _ = graph.matched_pixels((0, 1))
    for curve in epipolar_curves(essential_of(graph, (0, 1), cameras), cameras, pixels1):
        chord = (curve[-1] - curve[0]) / np.linalg.norm(curve[-1] - curve[0])
        offsets = (curve - curve[0]) @ np.array([-chord[1], chord[0]])
        assert np.abs(offsets).max() < 1e-9
        for x, y in (curve[0], curve[-1]):
            assert min(abs(x), abs(x - 640), abs(y), abs(y - 480)) < 1e-9


def test_epipolar_figure_draws_points_and_lines_of_one_colour():
    graph, _, cameras = scene_of()
    figure = epipolar_figure(graph, (0, 1), cameras, (None, None), max_lines=9)
    left, right = centers(figure, "point-0", 0), centers(figure, "point-1", 1)
    lines = drawn(figure, "epipolar-line", 1)
    assert len(lines) == len(left) == len(right) == 9
    for line, point in zip(lines, right, strict=True):
        assert distance_to_polyline(point, in_panel(figure, vertices(line), 1)) < 1.0
    pixels1, pixels2 = graph.matched_pixels((0, 1))
    for one, other in zip(left, right, strict=True):
        match = np.argmin(np.linalg.norm(pixels1 - one, axis=1))
        np.testing.assert_allclose(one, pixels1[match], atol=tolerance(figure, 0))
        np.testing.assert_allclose(other, pixels2[match], atol=tolerance(figure, 1))
    colors = [[e.get("fill") or "" for e in drawn(figure, f"point-{side}")] for side in (0, 1)]
    assert len(set(colors[0])) == 9
    assert colors[0] == colors[1] == [line.get("stroke") for line in lines]
    assert len(drawn(figure, "epipole", 1)) == 1


def test_epipole_is_the_projection_of_the_other_camera():
    graph, truth, cameras = scene_of()
    point = epipole(essential_of(graph, (0, 1), cameras), cameras[1])
    in_cam2 = truth.pose_of(1).apply(truth.pose_of(0).target_origin_in_source())
    expected = cameras[1].calibration_matrix() @ in_cam2
    np.testing.assert_allclose(np.cross(point, expected) / np.linalg.norm(expected), 0.0, atol=1e-6)


def test_a_fundamental_matrix_gives_the_same_lines():
    graph, _, cameras = scene_of()
    E = essential_of(graph, (0, 1), cameras)
    K_inv = np.linalg.inv(cameras[0].calibration_matrix())
    F = K_inv.T @ E @ K_inv
    inliers = graph.two_views[0, 1].inliers
    uncalibrated = graph.with_two_views({(0, 1): TwoView("uncalibrated", F, None, inliers)})
    np.testing.assert_allclose(essential_of(uncalibrated, (0, 1), cameras), E, rtol=1e-9, atol=1e-12)
    planar = graph.with_two_views({(0, 1): TwoView("planar", np.eye(3), None, inliers)})
    with pytest.raises(ValueError, match="planar"):
        epipolar_figure(planar, (0, 1), cameras, (None, None))


def test_matches_join_their_pixels_and_are_split_by_ransac():
    graph, _, cameras = scene_of(outlier_share=0.3)
    photos = (np.zeros((480, 640, 3), dtype=np.uint8), np.zeros((240, 320, 3), dtype=np.uint8))
    figure = matches_figure(graph, (0, 1), cameras, photos)
    inlier = graph.two_views[0, 1].inliers
    pixels1, pixels2 = graph.matched_pixels((0, 1))
    assert 0 < inlier.sum() < len(inlier)
    putative, atol = segments(figure, "putative"), tolerance(figure)
    np.testing.assert_allclose(putative[:, 0], pixels1, atol=atol)
    shift = putative[:, 1] - pixels2  # the second photo lies to the right, at the same height and scale
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=2 * atol)
    assert shift[0, 0] >= 640
    assert shift[0, 1] == pytest.approx(0.0, abs=atol)
    np.testing.assert_allclose(segments(figure, "kept", 1)[:, 0], pixels1[inlier], atol=atol)
    np.testing.assert_allclose(segments(figure, "rejected", 1)[:, 0], pixels1[~inlier], atol=atol)
    titles = words(figure)
    assert f"{len(inlier)} matches" in titles[0]
    assert f"{inlier.sum()} kept (green), {(~inlier).sum()} rejected" in titles[1]


def test_photos_lie_under_what_is_drawn_on_them():
    """Bright spots of the photos are where the matches of their centres are drawn."""
    graph, _, cameras = scene_of()
    matched = graph.matched_pixels((0, 1))
    photos = [np.zeros((480, 640, 3), dtype=np.uint8) for _ in range(2)]
    for side, photo in enumerate(photos):
        column, row = np.floor(matched[side][0]).astype(int)
        photo[row - 4 : row + 5, column - 4 : column + 5] = 255
    figure = matches_figure(graph, (0, 1), cameras, (photos[0], photos[1]))
    (match,) = segments(figure, "putative")[:1]
    for side in (0, 1):
        (group,) = (e for e in ET.fromstring(figure).iter() if e.get("id") == f"photo-{side}")
        (image,) = group
        uses = [e for e in ET.fromstring(figure).iter(f"{SVG}use") if e.get("href") == f"#photo-{side}"]
        assert len(uses) == 2  # once in each row
        bright = pixels(image).mean(axis=2)
        rows, columns = np.mgrid[: bright.shape[0], : bright.shape[1]] + 0.5
        spot = np.array([(columns * bright).sum(), (rows * bright).sum()]) / bright.sum()
        size = np.array([float(image.get("width", "")), float(image.get("height", ""))])
        corner = np.array([float(uses[0].get("x", "")), float(uses[0].get("y", ""))])
        on_page = corner + spot / [640, 480] * size
        np.testing.assert_allclose(
            in_panel(figure, on_page), match[side], atol=1.0
        )  # pixels: the spot is on whole ones


def test_many_matches_are_thinned_out_but_all_are_counted():
    graph, _, cameras = scene_of()
    figure = matches_figure(graph, (0, 1), cameras, (None, None), max_lines=10)
    assert len(segments(figure, "putative")) == 10
    assert f"{len(graph.matches[0, 1])} matches, 10 drawn" in words(figure)[0]


def test_photos_of_unlike_sizes_stand_side_by_side_at_one_height():
    graph, _, _ = scene_of()
    cameras = (Camera("SIMPLE_PINHOLE", 640, 480, np.array([600.0, 320, 240])),) + (
        Camera("SIMPLE_PINHOLE", 300, 960, np.array([600.0, 150, 480])),
    )
    figure = matches_figure(graph, (0, 1), cameras, (None, None))
    ends, atol = segments(figure, "putative"), tolerance(figure)
    pixels1, pixels2 = graph.matched_pixels((0, 1))
    np.testing.assert_allclose(ends[:, 0], 2.0 * pixels1, atol=atol)
    np.testing.assert_allclose(ends[:, 1, 1], pixels2[:, 1], atol=atol)


def record(stage: str, error: np.ndarray, count: int = 40, behind: int = 0) -> StageRecord:
    pixels = np.random.default_rng(1).uniform(0, 400, size=(count, 2))
    reprojected = pixels + error
    reprojected[:behind] = np.nan
    return StageRecord(stage, 0, "a.png", pixels, reprojected)


def test_error_vectors_end_at_the_reprojections():
    _, _, cameras = scene_of()
    records = [record("linear PnP", np.array([30.0, 0.0])), record("non-linear PnP", np.array([0.0, 0.3]), behind=3)]
    assert magnification(records, 640) == 1
    figure = reprojections_figure(records, cameras[0], None)
    for k, one in enumerate(records):
        in_front = np.isfinite(one.reprojected[:, 0])
        vectors, atol = segments(figure, "error-vectors", k), tolerance(figure, k)
        np.testing.assert_allclose(vectors[:, 0], one.pixels[in_front], atol=atol)
        np.testing.assert_allclose(vectors[:, 1], one.reprojected[in_front], atol=atol)
        np.testing.assert_allclose(positions(figure, "reprojected", k), one.reprojected[in_front], atol=atol)
        np.testing.assert_allclose(positions(figure, "observed", k), one.pixels[in_front], atol=atol)
        np.testing.assert_allclose(positions(figure, "behind", k), one.pixels[~in_front], atol=atol)
    assert "mean 30.00 px, 40 points" in words(figure)[0]
    assert "mean 0.30 px, 37 points, 3 behind" in words(figure)[1]


def test_an_error_vector_beyond_all_measure_keeps_its_direction():
    _, _, cameras = scene_of()
    figure = reprojections_figure([record("linear PnP", np.array([3e30, 4e30]), count=3)], cameras[0], None)
    ends = segments(figure, "error-vectors")
    along = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1, keepdims=True)
    np.testing.assert_allclose(along, np.broadcast_to([0.6, 0.8], (3, 2)), atol=1e-4)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min() > 800  # beyond the photo's diagonal


def test_small_errors_are_magnified_alike_in_all_panels_and_say_so():
    _, _, cameras = scene_of()
    records = [record("before BA", np.array([0.6, 0.0])), record("after BA", np.array([0.0, 0.3]))]
    assert magnification(records, 640) == 20  # 640 / 40 / 0.6 = 26.7
    figure = reprojections_figure(records, cameras[0], None)
    for k, length in enumerate((12.0, 6.0)):
        ends = segments(figure, "error-vectors", k)
        np.testing.assert_allclose(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), length, atol=2 * tolerance(figure))
        assert "×20" in words(figure)[k]


def test_a_stage_with_no_point_in_front_is_drawn():
    _, _, cameras = scene_of()
    figure = reprojections_figure([record("linear PnP", np.zeros(2), 5, behind=5)], cameras[0], None)
    assert "no point in front" in words(figure)[0]
    assert len(positions(figure, "behind")) == 5


@pytest.mark.parametrize(
    "name", ["$x^$.png", "a\nb\x00.png", "照片 1.png", "\\frac{", "%s" * 40, "<b>&amp;.png", "\udcff]]>.png"]
)
def test_any_name_can_be_drawn(name):
    graph, _, cameras = scene_of()
    named = type(graph)((name, name, name), graph.keypoints, graph.colors, graph.matches, graph.two_views)
    for figure in (matches_figure, epipolar_figure):
        shown = words(figure(named, (0, 1), cameras, (None, None)))  # parses what was drawn
        assert any(label(name) in text for text in shown)
