from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.scene.alignment import align
from fieldstone.solve.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, synthesize


@pytest.fixture(scope="module")
def runs():
    out = []
    for seed in range(3):
        options = SceneOptions(num_cameras=8, num_points=250, layout="arc", noise_px=0.6)
        scene = synthesize(options, np.random.default_rng(seed))
        one, known = np.zeros(8, dtype=np.int64), np.array([True])
        graph = verify_pairs(scene.graph, scene.truth.cameras, one, TwoViewOptions(), 0, 1)
        out.append((scene, map_automatic(graph, scene.truth.cameras, one, known, AutomaticOptions(covariance=True), 0)))
    return out


def test_the_noise_of_the_observations_is_found(runs):
    for _, run in runs:
        assert run.uncertainty.sigma_px == pytest.approx(0.6, rel=0.05)


def test_errors_against_the_truth_are_as_large_as_promised(runs):
    """Errors over their standard deviations, of all poses of all runs, have a root mean square of about one.

    Somewhat less for positions: the robust loss takes weight from the observations, and so promises too little.
    """
    centers, rotations = [], []
    for scene, run in runs:
        found = align(run.reconstruction, scene.truth)
        scale = found.position_error.mean() / _in_model_unit(found.position_error.mean(), run, scene)
        centers.append(found.position_error / (run.uncertainty.center * scale))
        rotations.append(np.rad2deg(found.rotation_error) / run.uncertainty.rotation_deg)
    for ratios in (np.concatenate(centers), np.concatenate(rotations)):
        assert 0.6 < np.sqrt(np.mean(ratios**2)) < 1.4


def test_covariances_are_symmetric_and_positive_and_only_on_request(runs):
    scene, run = runs[0]
    for blocks in (run.uncertainty.of_views, run.uncertainty.of_points):
        np.testing.assert_allclose(blocks, np.swapaxes(blocks, 1, 2), rtol=1e-6, atol=1e-18)
        assert np.all(np.linalg.eigvalsh(blocks) > -1e-12)
    assert len(run.uncertainty.of_points) == len(run.reconstruction.points)
    graph, cameras, one = run.graph, scene.truth.cameras, np.zeros(8, dtype=np.int64)
    plain = map_automatic(graph, cameras, one, np.array([True]), replace(AutomaticOptions(), covariance=False), 0)
    assert plain.uncertainty is None


def _in_model_unit(length: float, run, scene) -> float:
    """A length of the truth in the unit of the model."""
    model, truth = (
        np.stack([v.cam_from_world.target_origin_in_source() for v in r.views])
        for r in (run.reconstruction, scene.truth)
    )
    spread = [np.linalg.norm(c - c.mean(axis=0)) for c in (model, truth)]
    return float(length * spread[0] / spread[1])
