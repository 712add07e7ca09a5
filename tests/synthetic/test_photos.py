from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.geometry.camera import image_from_cam
from fieldstone.scene.rays import pixel_centers
from fieldstone.synthetic.photos import (
    FULL_FRAME_DIAGONAL_MM,
    TRUTH_FILE,
    PhotoOptions,
    camera_arc,
    develop,
    make_photos,
    photograph,
    read_truth,
    see,
    surface_points,
    write_photos,
)

SMALL = PhotoOptions(num_photos=3, width=96, height=72, texel=0.08, arc_deg=40.0)


@pytest.fixture(scope="module")
def photos():
    return make_photos(SMALL, np.random.default_rng(0), threads=2)


@pytest.fixture(scope="module")
def house(photos):
    return photos.house


@pytest.mark.parametrize("distortion", [0.0, -0.12])
def test_surface_points_lie_on_their_patches_and_under_their_pixels(house, distortion):
    options = replace(SMALL, radial_distortion=distortion)
    camera, pose = options.camera(), camera_arc(options, np.random.default_rng(1))[1]
    seen = see(house, camera, pose)
    points = surface_points(camera, pose, seen).reshape(-1, 3)
    solid = np.flatnonzero(seen.patch.ravel() >= 0)
    assert 0.5 < len(solid) / points.shape[0] < 1.0
    np.testing.assert_allclose(
        image_from_cam(camera, pose.apply(points[solid])),
        pixel_centers(options.width, options.height)[solid],
        atol=1e-6,
    )
    for k in solid[::37]:
        patch = house.patches[seen.patch.ravel()[k]]
        offset = points[k] - patch.origin
        assert abs(offset @ patch.normal) < 1e-8
        assert -1e-8 <= offset @ patch.edge_a <= patch.size_a + 1e-8
        assert -1e-8 <= offset @ patch.edge_b <= patch.size_b + 1e-8


def test_truth_agrees_with_itself_and_covers_all_photos(photos):
    truth = photos.truth
    assert np.max(truth.reprojection_errors()) < 1e-9
    tracks = np.bincount(truth.observations.point, minlength=len(truth.points))
    assert tracks.min() >= 1
    assert np.mean(tracks >= 2) > 0.6
    assert set(truth.observations.view.tolist()) == {0, 1, 2}
    centers = truth.camera_centers()
    assert np.all(np.linalg.norm(np.diff(centers, axis=0), axis=1) > 1.0)


def test_a_place_looks_the_same_in_every_photo(house):
    options = replace(SMALL, width=240, height=180, noise=0.0)
    camera, poses = options.camera(), camera_arc(options, np.random.default_rng(1))
    first, second = (photograph(house, camera, pose, options, np.random.default_rng(0)) for pose in poses[:2])
    seen = [see(house, camera, pose) for pose in poses[:2]]
    points = surface_points(camera, poses[0], seen[0])[4:-4:7, 4:-4:7].reshape(-1, 3)
    colors = first[4:-4:7, 4:-4:7].reshape(-1, 3)
    near = np.isfinite(points).all(axis=1) & (np.nan_to_num(np.abs(points), posinf=1e9).max(axis=1) < 12)
    points, colors = points[near], colors[near].astype(float)
    at = image_from_cam(camera, poses[1].apply(points))
    inside = np.all((at > 2) & (at < [options.width - 2, options.height - 2]), axis=1)
    column, row = at[inside].astype(int).T
    depth = poses[1].apply(points[inside])[:, 2]
    visible = np.abs(seen[1].depth[row, column] - depth) < 0.01 * depth
    there = second[row, column].astype(float)[visible]
    here = colors[inside][visible]
    assert len(here) > 150
    assert np.corrcoef(here.mean(axis=1), there.mean(axis=1))[0, 1] > 0.85
    assert np.median(np.abs(here - there)) < 12


@pytest.mark.slow
def test_photos_do_not_depend_on_the_number_of_threads(photos):
    again = make_photos(SMALL, np.random.default_rng(0), threads=1)
    for a, b in zip(photos.images, again.images, strict=True):
        np.testing.assert_array_equal(a, b)


def test_written_photos_carry_their_focal_length_and_the_truth(photos, tmp_path):
    paths = write_photos(photos, tmp_path / "house", SMALL)
    assert [p.name for p in paths] == [v.name for v in photos.truth.views]
    for path, image in zip(paths, photos.images, strict=True):
        with Image.open(path) as stored:
            focal_mm = stored.getexif().get_ifd(0x8769)[0xA405]
            assert np.abs(np.asarray(stored).astype(int) - image).mean() < 3.0
        focal = focal_mm / FULL_FRAME_DIAGONAL_MM * np.hypot(SMALL.width, SMALL.height)
        assert focal == pytest.approx(photos.truth.cameras[0].params[0], rel=1e-12)
    truth = read_truth(tmp_path / "house" / TRUTH_FILE)
    np.testing.assert_array_equal(truth.cameras[0].params, photos.truth.cameras[0].params)
    for k in range(3):
        np.testing.assert_array_equal(truth.pose_of(k).R, photos.truth.pose_of(k).R)
        np.testing.assert_array_equal(truth.pose_of(k).t, photos.truth.pose_of(k).t)


@pytest.mark.parametrize("text", ["", "{}", '{"cameras": [], "views": [{"name": 1}]}', "[1, 2]"])
def test_a_damaged_truth_file_is_named(tmp_path, text):
    (tmp_path / TRUTH_FILE).write_text(text)
    with pytest.raises(InputError, match=TRUTH_FILE):
        read_truth(tmp_path / TRUTH_FILE)


def test_options_refuse_what_cannot_be_photographed():
    for wrong in ({"num_photos": 0}, {"width": 3}, {"focal_35mm": 0}, {"samples_per_axis": 0}):
        with pytest.raises(ValueError):
            PhotoOptions(**wrong)


def test_developing_keeps_order_and_range():
    light = np.linspace(0.0, 50.0, 400)[:, None].repeat(3, axis=1)
    grey = develop(light)
    assert grey.min() == 0.0
    assert grey.max() <= 1.0
    assert np.all(np.diff(grey[:, 0]) >= 0)
