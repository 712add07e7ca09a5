import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from matchers import assert_reconstruction_near

GLOBAL = AutomaticOptions(mapper="global")


def mapped(graph: MatchGraph, cameras, camera_of_image, options=GLOBAL):
    graph = verify_pairs(graph, cameras, camera_of_image, TwoViewOptions(), 0, 2)
    return map_automatic(graph, cameras, camera_of_image, np.zeros(len(cameras)), options, 0)


@pytest.mark.parametrize("layout", ["arc", "ring"])
def test_known_cameras_are_placed_among_noise_and_outliers(layout):
    options = SceneOptions(
        num_cameras=12, num_points=500, layout=layout, noise_px=0.5, outlier_share=0.3, num_clutter=100
    )
    scene = synthesize(options, np.random.default_rng(0))
    run = mapped(scene.graph, scene.truth.cameras, np.zeros(12, dtype=np.int64))
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.2, relative_distance=0.005)


def test_both_mappers_end_in_the_same_minimum():
    scene = synthesize(
        SceneOptions(num_cameras=8, num_points=400, layout="arc", noise_px=0.5), np.random.default_rng(1)
    )
    one = np.zeros(8, dtype=np.int64)
    a = mapped(scene.graph, scene.truth.cameras, one).reconstruction
    b = mapped(scene.graph, scene.truth.cameras, one, AutomaticOptions()).reconstruction
    assert_reconstruction_near(a, b, angle_deg=1e-3, relative_distance=1e-4)


def test_two_unrelated_scenes_become_two_models():
    options = SceneOptions(num_cameras=6, num_points=300, layout="arc", noise_px=0.5)
    a, b = (synthesize(options, np.random.default_rng(seed)) for seed in (1, 2))
    graph = MatchGraph(
        tuple(f"{s}{n}" for s, scene in (("a", a), ("b", b)) for n in scene.graph.names),
        a.graph.keypoints + b.graph.keypoints,
        a.graph.colors + b.graph.colors,
        {**a.graph.matches, **{(i + 6, j + 6): rows for (i, j), rows in b.graph.matches.items()}},
    )
    run = mapped(graph, (a.truth.cameras[0], b.truth.cameras[0]), np.repeat([0, 1], 6))
    assert len(run.reconstruction.registered()) == 6
    assert [len(other.registered()) for other in run.others] == [6]
