from dataclasses import asdict

import numpy as np
import pytest

from fieldstone.mapping.textbook import TextbookOptions, map_textbook
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from matchers import assert_reconstruction_near

TEXTBOOK_STAGES = {
    "linear triangulation",
    "non-linear triangulation",
    "linear PnP",
    "PnP RANSAC",
    "non-linear PnP",
    "before BA",
    "after BA",
}


def run(options: SceneOptions, seed: int = 0, mapper: TextbookOptions | None = None):
    scene = synthesize(options, np.random.default_rng(seed))
    camera_of_image = np.array([view.camera for view in scene.truth.views])
    return scene, map_textbook(scene.graph, scene.truth.cameras, camera_of_image, mapper or TextbookOptions(), seed)


def test_exact_matches_give_exact_poses():
    scene, result = run(SceneOptions(num_cameras=5, num_points=120, layout="arc"))
    assert_reconstruction_near(result.reconstruction, scene.truth, angle_deg=1e-5, relative_distance=1e-6)
    assert result.reconstruction.reprojection_errors().max() < 1e-4


@pytest.mark.parametrize("seed", range(2))
def test_noise_and_outliers_still_register_every_photo(seed):
    options = SceneOptions(
        num_cameras=6, num_points=300, layout="arc", noise_px=0.5, outlier_share=0.4, num_clutter=100
    )
    scene, result = run(options, seed)
    assert_reconstruction_near(result.reconstruction, scene.truth, angle_deg=0.3, relative_distance=0.01)
    assert all(verdict.startswith("registered") for verdict in result.verdicts.values())
    # Errors of the two axes are 0.5 px each; a fit is no worse than the truth.
    errors = result.reconstruction.reprojection_errors()
    assert np.sqrt(np.mean(errors**2) / 2) < 0.55


def test_every_stage_is_recorded_and_refinement_never_hurts():
    _, result = run(SceneOptions(num_cameras=4, num_points=200, layout="arc", noise_px=1.0, outlier_share=0.2))
    rows = [asdict(record.row()) for record in result.records]
    assert {row["stage"] for row in rows} == TEXTBOOK_STAGES

    def rms(stage: str) -> float:
        errors = np.concatenate([r.errors() for r in result.records if r.stage == stage])
        return float(np.sqrt(np.mean(errors**2)))

    assert rms("non-linear PnP") < rms("PnP RANSAC")
    assert rms("non-linear triangulation") < rms("linear triangulation")
    assert rms("after BA") < rms("before BA")
    assert result.initial_pair is not None
    assert sorted(result.initial_pair.in_front)[2] < result.initial_pair.in_front[result.initial_pair.chosen]


def test_result_depends_on_the_seed_alone():
    options = SceneOptions(num_cameras=4, num_points=100, layout="arc", noise_px=0.5, outlier_share=0.3)
    _, first = run(options, 3)
    _, second = run(options, 3)
    np.testing.assert_array_equal(first.reconstruction.points.xyz, second.reconstruction.points.xyz)
    np.testing.assert_array_equal(first.reconstruction.observations.pixels, second.reconstruction.observations.pixels)


def test_a_photo_without_matches_is_left_out_with_a_verdict():
    scene = synthesize(SceneOptions(num_cameras=4, num_points=150, layout="arc"), np.random.default_rng(4))
    graph = scene.graph
    lonely = MatchGraph(
        (*graph.names, "lonely.png"),
        (*graph.keypoints, np.zeros((0, 2))),
        (*graph.colors, np.zeros((0, 3), dtype=np.uint8)),
        graph.matches,
    )
    result = map_textbook(lonely, scene.truth.cameras, np.zeros(5, dtype=np.int64), TextbookOptions(), 0)
    assert len(result.reconstruction.registered()) == 4
    assert result.verdicts["lonely.png"] == "not registered: sees no point of the model"


@pytest.mark.parametrize("matches", [{}, {(0, 1): np.zeros((5, 2), dtype=np.int64)}])
def test_too_few_matches_give_no_model_but_verdicts(matches):
    keypoints = tuple(np.random.default_rng(0).uniform(0, 500, size=(30, 2)) for _ in range(2))
    graph = MatchGraph(("a", "b"), keypoints, (np.zeros((30, 3), dtype=np.uint8),) * 2, matches)
    scene = synthesize(SceneOptions(num_cameras=2, num_points=20), np.random.default_rng(0))
    result = map_textbook(graph, scene.truth.cameras, np.zeros(2, dtype=np.int64), TextbookOptions(), 0)
    assert result.initial_pair is None
    assert len(result.reconstruction.registered()) == 0
    assert all("no pair" in verdict for verdict in result.verdicts.values())
