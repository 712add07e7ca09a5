"""A model as pycolmap holds it: equal to what pycolmap reads from our files."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.io.models.colmap import write_colmap
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import SceneOptions, synthesize

CAMERAS = (
    Camera("PINHOLE", 640, 480, np.array([700.0, 690.0, 330.0, 236.0])),
    Camera("RADIAL", 640, 480, np.array([600.0, 320.0, 240.0, -0.2, 0.05])),
    Camera("OPENCV_FISHEYE", 640, 480, np.array([300.0, 300.0, 320.0, 240.0, 0.02, -0.01, 0.002, 0.0])),
    Camera("FULL_OPENCV", 640, 480, np.array([600, 610, 320, 240, -0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0, 0.0])),
)


def model(camera: Camera, *, unregistered: int | None = 1) -> Reconstruction:
    """Five views of two cameras; one view has no pose, tracks differ in length, and not every keypoint is observed."""
    options = SceneOptions(num_cameras=5, num_points=60, camera=camera, noise_px=0.5, num_clutter=7)
    truth = synthesize(options, np.random.default_rng(0)).truth
    cameras = (camera, replace(camera, params=1.01 * camera.params))
    views = tuple(replace(v, camera=i % 2) for i, v in enumerate(truth.views))
    observations = truth.observations
    observations = observations.select((observations.view != 2) | (observations.point % 3 > 0))
    if unregistered is not None:
        views = tuple(replace(v, cam_from_world=None) if i == unregistered else v for i, v in enumerate(views))
        observations = observations.select(observations.view != unregistered)
    return Reconstruction(cameras, views, truth.points, observations)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_pycolmap_gets_what_it_reads_from_the_files(tmp_path, camera):
    pycolmap = pytest.importorskip("pycolmap")
    ours = model(camera)
    found = ours.to_pycolmap()
    write_colmap(ours, tmp_path)
    expected = pycolmap.Reconstruction(str(tmp_path))
    assert found.is_valid()
    for kind in ("cameras", "rigs", "frames", "images", "points3D"):
        assert sorted(getattr(found, kind)) == sorted(getattr(expected, kind)), kind
    assert found.reg_image_ids() == expected.reg_image_ids() == [1, 3, 4, 5]
    for c, camera_read in expected.cameras.items():
        camera_built = found.cameras[c]
        for name in ("model_name", "width", "height", "has_prior_focal_length"):
            assert getattr(camera_built, name) == getattr(camera_read, name), name
        np.testing.assert_array_equal(camera_built.params, camera_read.params)
    for i, image in expected.images.items():
        assert (found.images[i].name, found.images[i].camera_id) == (image.name, image.camera_id)
        np.testing.assert_allclose(
            found.images[i].cam_from_world().matrix(), image.cam_from_world().matrix(), rtol=0, atol=1e-14
        )
        points2D = [(*p.xy, p.point3D_id) for p in image.points2D]
        assert [(*p.xy, p.point3D_id) for p in found.images[i].points2D] == points2D
    for p, point in expected.points3D.items():
        ours_p = found.points3D[p]
        np.testing.assert_array_equal(ours_p.xyz, point.xyz)
        np.testing.assert_array_equal(ours_p.color, point.color)
        assert ours_p.error == pytest.approx(point.error, abs=1e-9)
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements]
        assert [(e.image_id, e.point2D_idx) for e in ours_p.track.elements] == elements


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_pycolmap_finds_our_reprojection_errors(camera):
    pytest.importorskip("pycolmap")
    ours = model(camera)
    errors, point = ours.reprojection_errors(), ours.observations.point
    of_points = np.bincount(point, weights=errors) / np.bincount(point)
    found = ours.to_pycolmap()
    np.testing.assert_allclose([found.points3D[p + 1].error for p in range(60)], of_points, rtol=0, atol=1e-9)
    assert found.compute_mean_reprojection_error() == pytest.approx(of_points.mean(), abs=1e-9)


def test_a_model_that_pycolmap_cannot_hold_is_refused():
    pytest.importorskip("pycolmap")
    whole, without = model(CAMERAS[0], unregistered=None), model(CAMERAS[0])
    with pytest.raises(ValueError, match="not registered"):
        replace(without, observations=whole.observations).to_pycolmap()
    o = whole.observations
    same = Observations(o.view, np.zeros_like(o.keypoint), o.point, o.pixels)
    with pytest.raises(ValueError, match="shows two points"):
        replace(whole, observations=same).to_pycolmap()


def test_without_pycolmap_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match="pip install pycolmap"):
        model(CAMERAS[0]).to_pycolmap()
