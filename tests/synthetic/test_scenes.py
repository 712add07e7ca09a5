"""Synthetic scenes: the laws that make them usable as an oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera, bearings_from_image
from fieldstone.geometry.epipolar import sampson_error
from fieldstone.geometry.triangulation import depths
from fieldstone.scene.tracks import build_tracks
from fieldstone.synthetic.scenes import SceneOptions, synthesize

CAMERAS = {
    "SIMPLE_PINHOLE": [700.0, 320.0, 240.0],
    "PINHOLE": [700.0, 690.0, 330.0, 236.0],
    "SIMPLE_RADIAL": [600.0, 320.0, 240.0, -0.15],
    "RADIAL": [600.0, 320.0, 240.0, -0.2, 0.05],
    "OPENCV": [600.0, 610.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002],
    "OPENCV_FISHEYE": [300.0, 300.0, 320.0, 240.0, 0.02, -0.01, 0.002, 0.0],
    "FULL_OPENCV": [600.0, 610.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0],
}


def variants() -> list[SceneOptions]:
    base = SceneOptions(num_cameras=6, num_points=80)
    return [
        *(replace(base, layout=layout) for layout in ("ring", "arc", "street", "random")),
        *(replace(base, layout=layout, point_shape="plane") for layout in ("ring", "street")),
        *(replace(base, camera=Camera(m, 640, 480, np.array(p)), layout="arc") for m, p in CAMERAS.items()),
    ]


@pytest.mark.parametrize("options", variants())
def test_exact_scene_obeys_projection_and_epipolar_geometry(options):
    scene = synthesize(options, np.random.default_rng(0))
    truth, graph = scene.truth, scene.graph
    assert len(truth.points) == options.num_points
    assert np.all(np.bincount(truth.observations.point, minlength=options.num_points) >= 2)
    assert truth.reprojection_errors().max() < 1e-9
    for i in range(options.num_cameras):
        observed = truth.observations.select(truth.observations.view == i)
        assert np.all(depths(truth.pose_of(i), truth.points.xyz[observed.point]) > 0)
        assert np.all((graph.keypoints[i] >= 0) & (graph.keypoints[i] < [options.camera.width, options.camera.height]))
        np.testing.assert_array_equal(graph.keypoints[i][observed.keypoint], observed.pixels)
        np.testing.assert_array_equal(graph.colors[i][observed.keypoint], truth.points.rgb[observed.point])
    verified = scene.verified_graph()
    assert graph.matches
    for pair, two_view in verified.two_views.items():
        x1, x2 = (bearings_from_image(options.camera, pixels) for pixels in graph.matched_pixels(pair))
        assert two_view.inliers.all()
        assert np.sqrt(sampson_error(two_view.matrix, x1, x2)).max() < 1e-9


def test_tracks_of_the_verified_graph_are_the_points():
    options = SceneOptions(num_points=100, outlier_share=0.4, num_clutter=30, noise_px=0.5, visibility=0.7)
    scene = synthesize(options, np.random.default_rng(1))
    observations, statistics = build_tracks(scene.verified_graph())
    truth = scene.truth.observations

    def tracks(o):
        members = {}
        for view, keypoint, point in zip(o.view, o.keypoint, o.point, strict=True):
            members.setdefault(int(point), set()).add((int(view), int(keypoint)))
        return {frozenset(m) for m in members.values()}

    assert statistics.dropped_conflicting == 0
    # Swapped-out matches may cut a track in two, but never join two points.
    whole = tracks(truth)
    assert all(any(track <= point for point in whole) for track in tracks(observations))


def test_noise_has_the_stated_standard_deviation():
    scene = synthesize(SceneOptions(num_points=2000, noise_px=0.7), np.random.default_rng(2))
    residuals = (scene.truth.reprojections() - scene.truth.observations.pixels).ravel()
    # Standard error of a standard deviation is sigma / sqrt(2 n).
    assert abs(residuals.std() - 0.7) < 5 * 0.7 / np.sqrt(2 * residuals.size)
    assert abs(residuals.mean()) < 5 * 0.7 / np.sqrt(residuals.size)


@pytest.mark.parametrize("num_clutter", [0, 200])
def test_outliers_have_the_stated_share_and_matches_are_one_to_one(num_clutter):
    options = SceneOptions(num_cameras=4, num_points=200, outlier_share=0.3, num_clutter=num_clutter)
    scene = synthesize(options, np.random.default_rng(3))
    for pair, rows in scene.graph.matches.items():
        assert abs((~scene.inliers[pair]).sum() - 0.3 * len(rows)) <= 0.5
        assert len(np.unique(rows[:, 0])) == len(np.unique(rows[:, 1])) == len(rows)
        x1, x2 = (bearings_from_image(options.camera, pixels) for pixels in scene.graph.matched_pixels(pair))
        error = sampson_error(scene.verified_graph().two_views[pair].matrix, x1, x2)
        assert np.sqrt(error[scene.inliers[pair]]).max() < 1e-9
        assert np.median(np.sqrt(error[~scene.inliers[pair]])) > 0.01


@pytest.mark.parametrize(
    ("topology", "expected"),
    [
        ("all_pairs", {(i, j) for j in range(6) for i in range(j)}),
        ("sequential", {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5)}),
        ("ring", {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (4, 5), (0, 4), (0, 5), (1, 5)}),
    ],
)
def test_topology_names_the_matched_pairs(topology, expected):
    options = SceneOptions(num_cameras=6, num_points=50, topology=topology, num_neighbors=2)
    assert set(synthesize(options, np.random.default_rng(0)).graph.matches) == expected


def test_tracks_are_no_longer_than_asked():
    options = SceneOptions(num_cameras=10, num_points=400, max_track_length=4)
    lengths = np.bincount(synthesize(options, np.random.default_rng(4)).truth.observations.point)
    assert lengths.max() == 4
    assert lengths.min() >= 2


def test_visibility_is_the_probability_of_an_observation():
    options = SceneOptions(num_cameras=8, num_points=1000)
    assert len(synthesize(options, np.random.default_rng(4)).truth.observations) == 8 * 1000
    half = synthesize(replace(options, visibility=0.5), np.random.default_rng(4))
    # Binomial(8, 1/2), given that it is at least 2: mean and variance in closed form.
    weights = np.array([28, 56, 70, 56, 28, 8, 1]) / 247
    mean = weights @ np.arange(2, 9)
    deviation = np.sqrt(weights @ (np.arange(2, 9) - mean) ** 2)
    assert abs(len(half.truth.observations) / 1000 - mean) < 5 * deviation / np.sqrt(1000)


def test_planar_points_lie_on_a_plane():
    points = synthesize(SceneOptions(point_shape="plane"), np.random.default_rng(0)).truth.points.xyz
    assert np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2] < 1e-12


def test_same_seed_same_scene():
    options = SceneOptions(noise_px=0.5, outlier_share=0.2, num_clutter=10, visibility=0.8)
    a, b, c = (synthesize(options, np.random.default_rng(seed)) for seed in (5, 5, 6))
    for pair, rows in a.graph.matches.items():
        np.testing.assert_array_equal(rows, b.graph.matches[pair])
    np.testing.assert_array_equal(a.truth.observations.pixels, b.truth.observations.pixels)
    assert not np.array_equal(a.truth.points.xyz, c.truth.points.xyz)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_cameras": 1}, "2 cameras"),
        ({"num_points": 0}, "1 point"),
        ({"visibility": 0.0}, "visibility"),
        ({"outlier_share": 1.0}, "outlier_share"),
        ({"noise_px": float("nan")}, "noise_px"),
        ({"max_track_length": 1}, "max_track_length"),
        ({"num_neighbors": 0}, "num_neighbors"),
        ({"num_clutter": -1}, "num_clutter"),
    ],
)
def test_wrong_options_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        SceneOptions(**wrong)
