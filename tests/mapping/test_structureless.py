from dataclasses import replace

import numpy as np
import pytest

from fieldstone.features.verification import verify_pairs
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.automatic import AutomaticOptions, map_automatic
from fieldstone.mapping.incremental.structureless import pose_from_partners
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.tracks import Observations
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_reconstruction_near, assert_rigid3_near

LAST = 7
ONE_CAMERA = np.zeros(8, dtype=np.int64)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    options = SceneOptions(num_cameras=8, num_points=900, layout="arc", noise_px=0.3)
    return synthesize(options, np.random.default_rng(0))


def with_lonely_last(scene: SyntheticScene) -> MatchGraph:
    """Every match of the last photo is with one other photo only, over points that nobody else matches."""
    matches, taken = {}, {}
    for pair, rows in scene.graph.matches.items():
        if pair[1] == LAST:
            mine = rows[rows[:, 1] % LAST == pair[0]]
            matches[pair] = mine
            taken[pair[0]] = set(mine[:, 0].tolist())
    for (i, j), rows in scene.graph.matches.items():
        if j != LAST:
            free = [a not in taken.get(i, set()) and b not in taken.get(j, set()) for a, b in rows.tolist()]
            matches[i, j] = rows[np.array(free, dtype=bool)]
    return replace(scene.graph, matches=matches)


def verified(scene: SyntheticScene, graph: MatchGraph) -> MatchGraph:
    return verify_pairs(graph, scene.truth.cameras, ONE_CAMERA, TwoViewOptions(), 0, 1)


def test_relative_poses_give_the_pose(scene):
    graph = verified(scene, scene.graph)
    model = WorkingModel.start(scene.truth.cameras, ONE_CAMERA, Observations.empty())
    truth = [view.cam_from_world for view in scene.truth.views]
    for v in range(LAST):
        assert truth[v] is not None
        model = model.with_pose(v, truth[v])
    found = pose_from_partners(model, graph, LAST, 12)
    assert found is not None
    assert_rigid3_near(found, truth[LAST], angle=np.deg2rad(0.3), distance=0.05)
    one = WorkingModel.start(scene.truth.cameras, ONE_CAMERA, Observations.empty()).with_pose(0, Rigid3.identity())
    assert pose_from_partners(one, graph, LAST, 12) is None


def test_a_photo_without_points_is_registered(scene):
    graph = verified(scene, with_lonely_last(scene))
    run = map_automatic(graph, scene.truth.cameras, ONE_CAMERA, np.zeros(1), AutomaticOptions(), 0)
    assert "relative poses" in run.verdicts[graph.names[LAST]]
    assert_reconstruction_near(run.reconstruction, scene.truth, angle_deg=0.3, relative_distance=0.01)
