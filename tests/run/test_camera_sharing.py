"""Which photos share a camera, by the pairs among them and, end to end, by real matches."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.geometry.rotation import angle_between
from fieldstone.run.matching.camera_sharing import Grouping, finer_groupings
from fieldstone.run.reconstruct import reconstruct
from fieldstone.run.reconstruct_options import ReconstructOptions
from fieldstone.solve.averaging.focal_lengths import FocalPrior, PairEvidence
from pair_worlds import PIXEL, nothing_known, world
from real_data import data_folder


def told_apart(focals, noise: float = 0.5, hint=None, stated: float = np.nan, seed: int = 0) -> np.ndarray:
    """Groups of photos that start as those of one camera; numbers in the order of their first photos."""
    n = len(focals)
    evidence = world(focals, noise * PIXEL, seed)
    prior = replace(nothing_known(1), stated=np.array([np.log(stated)]))
    start = Grouping.of(evidence, np.zeros(n, dtype=np.int64), prior)
    hint = np.zeros(n, dtype=np.int64) if hint is None else np.array(hint)
    *_, finest = [start, *finer_groupings(evidence, start, hint)]
    _, first, group = np.unique(finest.group, return_index=True, return_inverse=True)
    found = finest.log_focal
    np.testing.assert_allclose(np.exp(found), focals, rtol=0.1)
    return np.argsort(np.argsort(first))[group]


@pytest.mark.parametrize("seed", range(3))
def test_photos_of_one_camera_stay_together(seed):
    assert told_apart([0.9] * 7, seed=seed).tolist() == [0] * 7


def test_a_lens_that_breathes_is_one_lens():
    assert told_apart([0.88, 0.9, 0.92, 0.9, 0.89, 0.91]).tolist() == [0] * 6


@pytest.mark.parametrize("seed", range(3))
def test_two_cameras_in_turn_are_two(seed):
    assert told_apart([0.9, 0.55] * 4, seed=seed).tolist() == [0, 1] * 4


def test_a_zoom_lens_at_three_settings_is_three_cameras():
    assert told_apart([0.7, 1.0, 1.6] * 3).tolist() == [0, 1, 2] * 3


def test_photos_of_many_cameras_have_one_each():
    groups = told_apart([0.6, 0.8, 1.05, 1.4, 1.85, 2.4])
    assert len(set(groups.tolist())) == 6


def test_a_photo_without_pairs_stays_where_it_was():
    evidence = world([0.9, 0.55] * 3, 0.5 * PIXEL)
    start = Grouping.of(evidence, np.zeros(7, dtype=np.int64), nothing_known(1))
    *_, finest = finer_groupings(evidence, start, np.zeros(7, dtype=np.int64))
    assert finest.num_groups == 2


def test_folders_are_a_hint_that_photos_overrule():
    """Swapped between folders, photos are grouped by their lenses; alike in both, by none."""
    assert told_apart([0.9, 0.9, 0.9, 0.55, 0.55, 0.55], hint=[0, 0, 0, 1, 1, 1]).tolist() == [0, 0, 0, 1, 1, 1]
    assert told_apart([0.9, 0.55, 0.9, 0.9, 0.55, 0.55], hint=[0, 0, 0, 1, 1, 1]).tolist() == [0, 1, 0, 0, 1, 1]
    assert told_apart([0.9] * 6, hint=[0, 0, 0, 1, 1, 1]).tolist() == [0] * 6


def test_exif_that_holds_for_half_of_the_photos_is_left_by_the_other_half():
    assert told_apart([0.9, 0.5] * 4, stated=0.9).tolist() == [0, 1] * 4


def test_nothing_is_told_apart_without_pairs():
    nothing = PairEvidence(np.empty((0, 2), dtype=np.int64), np.empty((0, 3, 3)), np.empty((0, 9, 9)))
    start = Grouping.of(nothing, np.zeros(4, dtype=np.int64), nothing_known(1))
    assert not list(finer_groupings(nothing, start, np.arange(4)))
    assert isinstance(start.prior, FocalPrior)


@pytest.mark.slow
def test_two_phones_in_one_folder_are_found():
    """Photos of focal length 560 px (odd numbers) and 330 px (even) in one folder, all of one size, without EXIF."""
    folder = data_folder("hard_inputs/two_lenses")
    truth = {
        view["name"]: np.array(view["R"]) for view in json.loads((folder / "truth.json").read_text())["cam_from_world"]
    }
    model = reconstruct(folder, ReconstructOptions(threads=2)).model
    rotations = {view.name: view.cam_from_world.R for view in model.views if view.cam_from_world is not None}
    assert len(rotations) == 16
    # The world of the model is turned against that of the truth by one rotation, that of any view.
    turns = np.array([R.T @ truth[name] for name, R in rotations.items()])
    assert np.rad2deg(angle_between(turns, np.broadcast_to(turns[0], turns.shape)).max()) < 0.5
    for view in model.views:
        focal = 560.0 if int(view.name[4:8]) % 2 else 330.0
        assert model.cameras[view.camera].focal.mean() == pytest.approx(focal, rel=0.01)
