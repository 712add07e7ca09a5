import itertools

import numpy as np
import pytest

from fieldstone.geometry.camera import image_from_cam
from fieldstone.synthetic.turntable import (
    OBJECT_CENTER,
    TurntableOptions,
    photograph_turntable,
    turntable_poses,
)

OPTIONS = TurntableOptions(num_photos=4, width=160, height=120, focal_px=140.0, texel=0.05, noise=0.0)


@pytest.fixture(scope="module")
def photos():
    return photograph_turntable(OPTIONS, np.random.default_rng(0), threads=1)


def test_what_is_behind_stays_at_its_pixels(photos):
    behind = np.all([alpha == 0 for alpha in photos.alphas], axis=0)
    assert behind.mean() > 0.5
    for image in photos.images[1:]:
        np.testing.assert_array_equal(image[behind], photos.images[0][behind])


def test_the_object_turns_by_equal_steps_about_the_vertical():
    poses = turntable_poses(OPTIONS)
    for cam1, cam2 in itertools.pairwise(poses):
        turn = cam1.inverse().R @ cam2.R  # object from object, had the object stood still
        np.testing.assert_allclose(np.abs(np.arccos((np.trace(turn) - 1) / 2)), np.pi / 2, atol=1e-9)
        np.testing.assert_allclose(turn @ [0, 0, 1], [0, 0, 1], atol=1e-12)


def test_the_true_poses_put_the_object_where_alpha_shows_it(photos):
    # Points of the axis inside the lowest block are covered by it in every photo.
    axis = np.column_stack([np.zeros((5, 2)), np.linspace(0.2, 0.7, 5)])
    for pose, alpha in zip(photos.poses, photos.alphas, strict=True):
        column, row = image_from_cam(photos.camera, pose.apply(axis)).astype(int).T
        assert (alpha[row, column] == 255).all()
    middle = image_from_cam(photos.camera, photos.poses[0].apply(OBJECT_CENTER[None]))
    np.testing.assert_allclose(middle[0], [80.0, 60.0], atol=1e-9)
