"""Errors against a truth: models that are moved, turned, bent or folded by a known amount."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.ground_truth import posed
from benchmarks.real_sets import SETS, chosen
from benchmarks.truth_errors import camera_error, loose_counts, truth_errors

from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp, random_rotation
from fieldstone.geometry.sim3 import Sim3
from fieldstone.scene.alignment import transformed
from fieldstone.scene.reconstruction import Reconstruction

CAMERA = Camera("PINHOLE", 640, 480, np.array([500.0, 510.0, 320.0, 240.0]))


def truth_of(n: int = 8) -> Reconstruction:
    rng = np.random.default_rng(0)
    poses = [Rigid3(R, rng.normal(size=3)) for R in random_rotation(n, rng)]
    return posed([f"{k}.jpg" for k in range(n)], [CAMERA] * n, poses)


def turned(model: Reconstruction, photos: list[int], angle_deg: float) -> Reconstruction:
    """The cameras of some photos, turned where they stand."""
    views = list(model.views)
    for k in photos:
        cam_from_cam = Rigid3(exp(np.deg2rad([0.0, angle_deg, 0.0])), np.zeros(3))
        views[k] = replace(views[k], cam_from_world=cam_from_cam @ model.pose_of(k))
    return replace(model, views=tuple(views))


def test_the_frame_of_a_model_is_no_error():
    truth = truth_of()
    rng = np.random.default_rng(1)
    errors = truth_errors(transformed(truth, Sim3(3.0, random_rotation(1, rng)[0], rng.normal(size=3))), truth)
    assert errors.photos == 8
    assert errors.rotation_deg == pytest.approx(0.0, abs=1e-5)
    assert errors.position_share == pytest.approx(0.0, abs=1e-9)
    assert (errors.focal_percent, errors.corner_px) == (0.0, pytest.approx(0.0, abs=1e-9))


def test_one_turned_photo_is_wrong_by_its_angle_and_the_others_by_nothing():
    truth = truth_of()
    errors = truth_errors(turned(truth, [3], 24.0), truth)
    assert errors.rotation_deg == pytest.approx(24.0)
    assert errors.rotation_mean_deg == pytest.approx(24.0 / 8)


def test_loose_counts_are_those_of_every_model_on_its_own():
    truth = truth_of()
    largest = turned(truth, [0, 1], 40.0)
    small = turned(posed(["0.jpg", "1.jpg"], [CAMERA] * 2, [truth.pose_of(0), truth.pose_of(1)]), [0], 20.0)
    counts = loose_counts([largest, small], truth)
    assert (counts.right_largest, counts.wrong_largest) == (6, 2)
    assert (counts.right_all, counts.wrong_all) == (7, 2)


def test_a_mirrored_model_is_wrong():
    truth = truth_of()
    flip = np.diag([1.0, 1.0, -1.0])
    views = [replace(v, cam_from_world=Rigid3(flip @ p.R @ flip, flip @ p.t)) for v, p in poses_of(truth)]
    errors = truth_errors(replace(truth, views=tuple(views)), truth)
    assert errors.rotation_deg is not None
    assert errors.rotation_deg > 90.0


def poses_of(model: Reconstruction):
    return [(view, model.pose_of(k)) for k, view in enumerate(model.views)]


def test_focal_lengths_are_compared_in_the_size_of_the_photo():
    half = Camera("PINHOLE", 320, 240, np.array([250.0, 255.0, 160.0, 120.0]))
    assert camera_error(half, CAMERA) == (pytest.approx(0.0), pytest.approx(0.0, abs=1e-9))
    longer = Camera("PINHOLE", 320, 240, np.array([275.0, 280.5, 158.0, 121.0]))
    focal, corner = camera_error(longer, CAMERA)
    assert focal == pytest.approx(10.0)
    # x = (u - c) / 1.1: the farthest corner, measured from the middle, moves by a part of 1 - 1 / 1.1.
    assert corner == pytest.approx((1.0 - 1.0 / 1.1) * np.hypot(160.0, 120.0))


def test_every_set_has_its_own_name_and_both_halves_have_a_truth():
    assert len({each.name for each in SETS}) == len(SETS)
    for half in ("develop", "confirm"):
        assert sum(each.truth != "none" for each in chosen([], half)) >= 5
    with pytest.raises(ValueError, match="no set is called moon"):
        chosen(["moon"], None)
