"""What is fixed to the camera is told from a scene, whose geometry is known here, point by point."""

from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.static_content import StaticContent, find_static_content
from fieldstone.geometry.camera import image_from_cam
from fieldstone.geometry.rigid3 import Rigid3, look_at
from fieldstone.geometry.rotation import exp
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import default_camera

CAMERA = default_camera()
UP = np.array([0.0, 0.0, 1.0])
NOISE_PX = 0.3


def ball(rng, count=200):
    return rng.normal(size=(count, 3))


def around(count, sweep_deg=60.0):
    angles = np.deg2rad(np.linspace(0.0, sweep_deg, count))
    return [
        look_at(np.array([8 * np.cos(a), 8 * np.sin(a), 2.0 + 0.3 * k]), np.zeros(3), UP) for k, a in enumerate(angles)
    ]


def on_sensor(rng, count, low=(50, 600), high=(900, 740)):
    """Places of an overlay."""
    return rng.uniform(low, high, size=(count, 2))


def graph_of(views, rng):
    """Photos whose keypoints carry the number of what they show; equal numbers match.

    Args:
        views: Of every photo, (numbers, exact pixels).
    """
    keypoints = [pixels + NOISE_PX * rng.normal(size=pixels.shape) for _, pixels in views]
    matches = {}
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            _, a, b = np.intersect1d(views[i][0], views[j][0], return_indices=True)
            if len(a):
                matches[i, j] = np.stack([a, b], axis=1)
    colors = tuple(np.zeros((len(k), 3), dtype=np.uint8) for k in keypoints)
    return MatchGraph(tuple(f"{k}.jpg" for k in range(len(views))), tuple(keypoints), colors, matches)


def view(pose: Rigid3, points, first=0):
    return first + np.arange(len(points)), image_from_cam(CAMERA, pose.apply(points))


def joined(*parts):
    return np.concatenate([numbers for numbers, _ in parts]), np.concatenate([pixels for _, pixels in parts])


def found_in(views, rng):
    graph = graph_of(views, rng)
    return graph, find_static_content(graph, [CAMERA] * len(views), TwoViewOptions(), seed=0, threads=1)


def content_of(views, rng) -> StaticContent:
    """Where there is some."""
    found = found_in(views, rng)[1]
    assert found is not None
    return found


@pytest.mark.parametrize("overlaid", [40, 400])  # a few words, and twice as many features as the scene has
def test_an_overlay_is_found_and_the_scene_is_kept(overlaid):
    rng = np.random.default_rng(0)
    points, sign = ball(rng), (1000 + np.arange(overlaid), on_sensor(rng, overlaid))
    found = content_of([joined(view(pose, points), sign) for pose in around(6)], rng)
    assert found.decided
    for static in found.features:
        assert static[len(points) :].mean() > 0.95
        covered = static[: len(points)]  # points of the scene behind the overlay
        assert covered.mean() < 0.02
    if overlaid == 400:
        cells = found.regions[0]
        assert cells is not None
        rows, columns = np.nonzero(cells)
        cell = CAMERA.width / cells.shape[1]
        assert len(rows) > 20
        assert (columns + 1).min() * cell > 50
        assert (rows + 1).min() * cell > 600


def test_what_changes_within_an_overlay_is_left_out_with_it():
    rng = np.random.default_rng(1)
    points, sign = ball(rng), (1000 + np.arange(900), on_sensor(rng, 900))
    clocks = [(5000 + 10 * k + np.arange(10), on_sensor(rng, 10, (400, 650), (500, 700))) for k in range(6)]
    views = [joined(view(pose, points), sign, clock) for pose, clock in zip(around(6), clocks, strict=True)]
    found = content_of(views, rng)
    assert all(static[-10:].mean() > 0.7 for static in found.features)


def test_an_ordinary_scene_has_none():
    rng = np.random.default_rng(2)
    points = ball(rng)
    assert found_in([view(pose, points) for pose in around(6)], rng)[1] is None


def test_a_camera_at_rest_is_said_and_loses_nothing():
    rng = np.random.default_rng(3)
    points, pose = ball(rng), around(1)[0]
    found = content_of([view(pose, points)] * 4, rng)
    assert not found.decided
    assert not np.concatenate(found.features).any()


def test_a_panorama_has_none():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(400, 3)) + [0.0, 0.0, 8.0]
    poses = [Rigid3(exp(np.array([0.02 * k, 0.06 * k, 0.01])), np.zeros(3)) for k in range(5)]
    assert found_in([view(pose, points) for pose in poses], rng)[1] is None


def test_a_far_horizon_before_a_camera_that_goes_straight_on_is_scene():
    rng = np.random.default_rng(5)
    far = rng.uniform([-2000, -300, 4000], [2000, 300, 5000], size=(100, 3))
    near = rng.uniform([-8, -2, 12], [8, 2, 30], size=(300, 3))
    poses = [Rigid3(np.eye(3), np.array([0.0, 0.0, -0.8 * k])) for k in range(6)]
    views = [joined(view(pose, near), view(pose, far, 1000)) for pose in poses]
    graph, found = found_in(views, rng)
    still = np.linalg.norm(np.subtract(*graph.matched_pixels((0, 1))), axis=1) < 1.0
    assert still.sum() >= 90  # the horizon hardly moves
    assert found is None or not np.concatenate(found.features).any()


def test_a_camera_that_rests_while_somebody_walks_by_keeps_the_scene():
    rng = np.random.default_rng(6)
    scene, body = ball(rng, 300), 0.4 * ball(rng, 80)
    walk = [Rigid3(exp(np.array([0.0, 0.0, 0.3 * k])), np.array([0.3 * k, 0.4 * k, 0.0])) for k in range(4)]
    rest = around(1)[0]
    burst = [joined(view(rest, scene), view(rest @ step, body, 1000)) for step in walk]
    moving = [view(pose, scene) for pose in around(5)[1:]]
    _, found = found_in([*burst, *moving], rng)
    assert found is None or not np.concatenate([static[:300] for static in found.features]).any()


def test_of_two_photos_nothing_is_decided():
    rng = np.random.default_rng(7)
    points, sign = ball(rng), (1000 + np.arange(300), on_sensor(rng, 300))
    _, found = found_in([joined(view(pose, points), sign) for pose in around(2)], rng)
    assert found is None or not np.concatenate(found.features).any()


def test_photos_of_another_size_are_not_compared():
    rng = np.random.default_rng(8)
    points, sign = ball(rng), (1000 + np.arange(100), on_sensor(rng, 100))
    graph = graph_of([joined(view(pose, points), sign) for pose in around(4)], rng)
    cameras = [replace(CAMERA, width=CAMERA.width + k) for k in range(4)]
    assert find_static_content(graph, cameras, TwoViewOptions(), seed=0, threads=1) is None
