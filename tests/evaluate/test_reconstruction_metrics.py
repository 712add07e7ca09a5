from dataclasses import replace

import numpy as np

from fieldstone.evaluate.reconstruction_metrics import (
    area_under_curve,
    pairwise_pose_errors_deg,
    relative_pose_errors,
)
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, random_rotation
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.alignment import align, transformed
from fieldstone.synthetic.scenes import SceneOptions, synthesize


def scene():
    return synthesize(SceneOptions(num_cameras=5, num_points=40), np.random.default_rng(0)).truth


def test_errors_ignore_a_similarity_of_the_world():
    truth = scene()
    R = random_rotation(1, np.random.default_rng(1))[0]
    moved = transformed(truth, Sim3(3.0, R, np.array([1.0, 2.0, 3.0])))
    assert pairwise_pose_errors_deg(moved, truth).max() < 1e-6
    comparison = align(moved, truth)
    assert comparison.position_error.max() < 1e-9
    assert comparison.rotation_error.max() < 1e-9
    np.testing.assert_allclose(moved.reprojection_errors(), truth.reprojection_errors(), atol=1e-8)


def test_a_turned_photo_spoils_its_pairs_by_its_angle_and_a_missing_one_counts_as_inf():
    truth = scene()
    views = list(truth.views)
    pose = truth.pose_of(2)
    turn = Rigid3(exp(np.array([0.0, 0.0, np.deg2rad(2.0)])), np.zeros(3))
    views[2] = replace(views[2], cam_from_world=turn @ pose)
    errors = pairwise_pose_errors_deg(replace(truth, views=tuple(views)), truth)
    assert np.sum(errors > 1e-6) == 4
    assert np.all(errors[errors > 1e-6] > 2.0 - 1e-9)
    views[2] = replace(views[2], cam_from_world=None)
    errors = pairwise_pose_errors_deg(replace(truth, views=tuple(views)), truth)
    assert np.isinf(errors).sum() == 4
    assert len(errors) == 10


def test_translation_direction_error_is_exact_at_both_ends():
    t = np.array([[1.0, 0, 0]] * 4)
    other = np.array([[2.0, 0, 0], [np.cos(1e-9), np.sin(1e-9), 0], [0, 1, 0], [-1, 0, 0]])
    R = np.broadcast_to(np.eye(3), (4, 3, 3))
    np.testing.assert_allclose(
        relative_pose_errors(Rigid3(R, other), Rigid3(R, t)), [0, 1e-9, np.pi / 2, np.pi], atol=1e-15
    )


def test_area_under_curve_matches_integration_of_the_recall():
    errors = np.random.default_rng(2).exponential(2.0, size=50)
    errors[:3] = np.inf
    grid = (np.arange(200_000) + 0.5) / 200_000
    for threshold, area in zip((1.0, 5.0), area_under_curve(errors, (1.0, 5.0)), strict=True):
        recall = np.searchsorted(np.sort(errors), grid * threshold, side="right") / 50
        np.testing.assert_allclose(area, 100 * recall.mean(), atol=1e-3)
    assert area_under_curve(np.zeros(3), [1.0]) == [100.0]
