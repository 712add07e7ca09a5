from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.rotation import log
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.model.uncertainty import LOSSES, robust_factor
from fieldstone.scene.alignment import align, transformed
from fieldstone.solve.bundle import covariance
from fieldstone.solve.bundle.adjustment import BundleOptions
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, synthesize


@pytest.fixture(scope="module")
def runs():
    out = []
    for seed in range(3):
        options = SceneOptions(num_cameras=8, num_points=250, layout="arc", noise_px=0.6)
        scene = synthesize(options, np.random.default_rng(seed))
        one, exact = np.zeros(8, dtype=np.int64), np.zeros(1)
        graph = verify_pairs(scene.graph, scene.truth.cameras, one, TwoViewOptions(), 0, 1)
        out.append((scene, map_automatic(graph, scene.truth.cameras, one, exact, AutomaticOptions(covariance=True), 0)))
    return out


def test_the_noise_of_the_observations_is_found(runs):
    for _, run in runs:
        assert run.uncertainty.sigma_px == pytest.approx(0.6, rel=0.05)


def test_errors_against_the_truth_are_as_large_as_promised(runs):
    """Errors over their standard deviations, of all poses of all runs, have a root mean square of about one.

    24 poses with three numbers each, whose errors depend on each other, tell it to about a tenth.
    """
    centers, rotations = [], []
    for scene, run in runs:
        off_center, turned = errors_in_gauge_of_least_variance(run.reconstruction, scene.truth)
        centers.append(off_center / run.uncertainty.center)
        rotations.append(np.rad2deg(turned) / run.uncertainty.rotation_deg)
    for ratios in (np.concatenate(centers), np.concatenate(rotations)):
        assert 0.75 < np.sqrt(np.mean(ratios**2)) < 1.25


def errors_in_gauge_of_least_variance(model, truth) -> tuple[np.ndarray, np.ndarray]:
    """Errors of camera centres (unit of the model) and rotations (radians) when the truth is moved so that the tangents
    (omega, v) about the median point, summed up squared, are least: no common turn, shift or scale is left in them."""
    truth = transformed(truth, align(truth, model).reference_from_model)
    R_true, c_true = (np.stack([getattr(v.cam_from_world, n) for v in truth.views]) for n in ("R", "t"))
    R, t = (np.stack([getattr(v.cam_from_world, n) for v in model.views]) for n in ("R", "t"))
    c_true = -np.einsum("vji,vj->vi", R_true, c_true)
    c = -np.einsum("vji,vj->vi", R, t)
    pivot = np.median(model.points.xyz, axis=0)
    omega = log(np.swapaxes(R_true, 1, 2) @ R)
    v = np.cross(c_true - pivot, omega) - (c - c_true)
    omega = omega - omega.mean(axis=0)
    moves = np.concatenate([np.tile(np.eye(3), (len(c), 1)), (c_true - pivot).reshape(-1, 1)], axis=1)
    v = v - (moves @ np.linalg.lstsq(moves, v.ravel())[0]).reshape(-1, 3)
    off_center = np.cross(c_true - pivot, omega) - v
    return np.linalg.norm(off_center, axis=1), np.linalg.norm(omega, axis=1)


@pytest.mark.parametrize(("loss", "scale"), [("trivial", 1.0), ("soft_l1", 1.0), ("cauchy", 1.4), ("huber", 0.8)])
def test_robust_estimates_scatter_as_the_factor_says(loss, scale):
    """The location of a cloud, estimated many times by reweighting, against sigma^2 / sum w with the factor."""
    rng, count, sigma = np.random.default_rng(0), 400, 0.6
    options = BundleOptions(loss=loss, loss_scale_px=scale)
    rho = LOSSES[loss](scale)
    cloud = sigma * rng.normal(size=(1500, count, 2))
    center, weight = cloud.mean(axis=1), np.ones(cloud.shape[:2])
    for _ in range(30):
        weight = rho(np.sum((cloud - center[:, None]) ** 2, axis=2))[1]
        center = np.sum(weight[..., None] * cloud, axis=1) / weight.sum(axis=1)[:, None]
    errors = np.linalg.norm(cloud[0] - center[0], axis=1)
    promised = sigma * robust_factor(errors, options) / np.sqrt(weight[0].sum())
    # One cloud tells its own factor to 5 %, all of them together the scatter to 1.3 %.
    assert center.std() == pytest.approx(promised, rel=0.1)


def test_covariances_are_symmetric_and_positive_and_only_on_request(runs):
    scene, run = runs[0]
    for blocks in (run.uncertainty.of_views, run.uncertainty.of_points):
        np.testing.assert_allclose(blocks, np.swapaxes(blocks, 1, 2), rtol=1e-6, atol=1e-18)
        assert np.all(np.linalg.eigvalsh(blocks) > -1e-12)
    assert len(run.uncertainty.of_points) == len(run.reconstruction.points)
    graph, cameras, one = run.graph, scene.truth.cameras, np.zeros(8, dtype=np.int64)
    plain = map_automatic(graph, cameras, one, np.zeros(1), replace(AutomaticOptions(), covariance=False), 0)
    assert plain.uncertainty is None


def test_a_model_too_large_for_a_covariance_is_a_model_and_a_note(runs, monkeypatch):
    """12,000 columns are some 2,000 photos; 8 photos are 48."""
    scene, run = runs[0]
    monkeypatch.setattr(covariance, "MAX_COLUMNS", 47)
    one = np.zeros(8, dtype=np.int64)
    options = AutomaticOptions(covariance=True)
    without = map_automatic(run.graph, scene.truth.cameras, one, np.zeros(1), options, 0)
    assert without.uncertainty is None
    np.testing.assert_array_equal(without.reconstruction.points.xyz, run.reconstruction.points.xyz)
    assert [note for note in without.notes if "no covariance" in note and "47 are allowed" in note]
