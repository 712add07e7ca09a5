"""COLMAP models: round trips, pycolmap as the oracle in both directions, third-party habits, damage."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.io.models.colmap import read_colmap, read_colmap_model, write_colmap
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from matchers import assert_rigid3_near
from mutations import check_mutations
from real_data import data_folder

CAMERAS = [
    Camera("SIMPLE_PINHOLE", 640, 480, np.array([700.0, 320.0, 240.0])),
    Camera("PINHOLE", 640, 480, np.array([700.0, 690.0, 330.0, 236.0])),
    Camera("SIMPLE_RADIAL", 640, 480, np.array([600.0, 320.0, 240.0, -0.15])),
    Camera("RADIAL", 640, 480, np.array([600.0, 320.0, 240.0, -0.2, 0.05])),
    Camera("OPENCV", 640, 480, np.array([600.0, 610.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002])),
    Camera("OPENCV_FISHEYE", 640, 480, np.array([300.0, 300.0, 320.0, 240.0, 0.02, -0.01, 0.002, 0.0])),
    Camera(
        "FULL_OPENCV", 640, 480, np.array([600.0, 610.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0, 0])
    ),
]


def make_scene(camera: Camera = CAMERAS[1], num_points: int = 50) -> SyntheticScene:
    options = SceneOptions(num_cameras=4, num_points=num_points, camera=camera, noise_px=0.5, num_clutter=7)
    return synthesize(options, np.random.default_rng(0))


def assert_same(actual: Reconstruction, expected: Reconstruction) -> None:
    assert len(actual.cameras) == len(expected.cameras)
    for a, b in zip(actual.cameras, expected.cameras, strict=True):
        assert (a.model, a.width, a.height) == (b.model, b.width, b.height)
        np.testing.assert_array_equal(a.params, b.params)
    assert [(v.name, v.camera) for v in actual.views] == [(v.name, v.camera) for v in expected.views]
    for v in range(len(expected.views)):
        # The quaternion in the file rounds the matrix.
        assert_rigid3_near(actual.pose_of(v), expected.pose_of(v), angle=1e-14, distance=0)
    np.testing.assert_array_equal(actual.points.xyz, expected.points.xyz)
    np.testing.assert_array_equal(actual.points.rgb, expected.points.rgb)
    for name in ("view", "point", "pixels"):
        np.testing.assert_array_equal(getattr(actual.observations, name), getattr(expected.observations, name))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_round_trip_is_exact(tmp_path, camera, binary):
    scene = make_scene(camera)
    write_colmap(scene.truth, tmp_path / "m", keypoints=scene.graph.keypoints, binary=binary)
    model = read_colmap_model(tmp_path / "m")
    assert_same(model.reconstruction, scene.truth)
    np.testing.assert_array_equal(model.reconstruction.observations.keypoint, scene.truth.observations.keypoint)
    for read, written in zip(model.keypoints, scene.graph.keypoints, strict=True):
        np.testing.assert_array_equal(read, written)
    np.testing.assert_array_equal(model.point_ids, np.arange(1, 51))
    first = scene.truth.observations.point == 0
    assert model.point_errors[0] == pytest.approx(scene.truth.reprojection_errors()[first].mean(), rel=1e-12)
    assert not list((tmp_path / "m").glob(".writing*"))


def test_without_the_graph_the_observed_keypoints_are_numbered_anew(tmp_path):
    truth = make_scene().truth
    write_colmap(truth, tmp_path)
    model = read_colmap_model(tmp_path)
    assert_same(model.reconstruction, truth)
    for v, keypoints in enumerate(model.keypoints):
        assert len(keypoints) == (truth.observations.view == v).sum()


def test_unregistered_views_and_their_cameras_are_left_out(tmp_path):
    truth = make_scene().truth
    views = (*truth.views[:3], replace(truth.views[3], cam_from_world=None, camera=1))
    observations = truth.observations.select(truth.observations.view < 3)
    model = replace(truth, cameras=(*truth.cameras, CAMERAS[0]), views=views, observations=observations)
    write_colmap(model, tmp_path)
    read = read_colmap(tmp_path)
    assert [view.name for view in read.views] == [view.name for view in views[:3]]
    assert len(read.cameras) == 1
    with pytest.raises(ValueError, match="no view is registered"):
        write_colmap(replace(model, views=(views[3],), observations=observations.empty()), tmp_path)
    with pytest.raises(ValueError, match="not registered"):
        write_colmap(replace(model, observations=truth.observations), tmp_path)


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
def test_pycolmap_opens_what_is_written_and_computes_the_same_errors(tmp_path, camera, binary):
    pycolmap = pytest.importorskip("pycolmap")
    scene = make_scene(camera)
    write_colmap(scene.truth, tmp_path, keypoints=scene.graph.keypoints, binary=binary)
    theirs = pycolmap.Reconstruction(str(tmp_path))
    assert (theirs.num_reg_images(), theirs.num_points3D(), theirs.num_frames()) == (4, 50, 4)
    observations, errors = scene.truth.observations, scene.truth.reprojection_errors()
    for k in range(len(observations)):
        image = theirs.images[int(observations.view[k]) + 1]
        assert image.name == scene.truth.views[int(observations.view[k])].name
        point = theirs.points3D[image.points2D[int(observations.keypoint[k])].point3D_id]
        np.testing.assert_array_equal(point.color, scene.truth.points.rgb[observations.point[k]])
        projected = theirs.cameras[image.camera_id].img_from_cam(image.cam_from_world() * point.xyz)
        error = np.linalg.norm(projected - image.points2D[int(observations.keypoint[k])].xy)
        assert error == pytest.approx(errors[k], rel=1e-9, abs=1e-9)
    stored = [theirs.points3D[p + 1].error for p in range(50)]
    theirs.update_point_3d_errors()
    np.testing.assert_allclose(stored, [theirs.points3D[p + 1].error for p in range(50)], rtol=1e-9)


@pytest.mark.parametrize("binary", [True, False])
def test_models_that_pycolmap_writes_are_read(tmp_path, binary):
    pycolmap = pytest.importorskip("pycolmap")
    scene = make_scene()
    write_colmap(scene.truth, tmp_path / "ours", keypoints=scene.graph.keypoints)
    theirs = pycolmap.Reconstruction(str(tmp_path / "ours"))
    (tmp_path / "theirs").mkdir()
    (theirs.write_binary if binary else theirs.write_text)(str(tmp_path / "theirs"))
    read = read_colmap(tmp_path / "theirs")
    assert_same(read, scene.truth)
    np.testing.assert_array_equal(read.observations.keypoint, scene.truth.observations.keypoint)


@pytest.mark.parametrize(
    ("name", "pose_atol", "error_atol"),
    [
        # Its quaternions have six digits: pycolmap takes them as they are, we make rotations of them.
        ("lund_door/colmap_ground_truth", 1e-6, 5e-3),
        ("astrovision/test_2011212_opnav_022", 1e-12, 1e-9),
    ],
)
def test_third_party_models_agree_with_pycolmap(name, pose_atol, error_atol):
    pycolmap = pytest.importorskip("pycolmap")
    folder = data_folder(name.partition("/")[0]) / name.partition("/")[2]
    ours, theirs = read_colmap_model(folder), pycolmap.Reconstruction(str(folder))
    model = ours.reconstruction
    assert len(model.views) == theirs.num_reg_images()
    assert len(model.points) == theirs.num_points3D()
    assert len(model.observations) == theirs.compute_num_observations()
    for v, image_id in enumerate(ours.image_ids.tolist()):
        image = theirs.images[image_id]
        assert image.name == model.views[v].name
        np.testing.assert_allclose(model.pose_of(v).matrix()[:3], image.cam_from_world().matrix(), atol=pose_atol)
        np.testing.assert_array_equal(ours.keypoints[v], [p.xy for p in image.points2D])
    for k in range(0, len(model.points), 97):
        np.testing.assert_array_equal(model.points.xyz[k], theirs.points3D[int(ours.point_ids[k])].xyz)
    theirs.update_point_3d_errors()
    expected = [theirs.points3D[i].error for i in ours.point_ids.tolist()]
    count = np.bincount(model.observations.point)
    mean = np.bincount(model.observations.point, weights=model.reprojection_errors()) / count
    np.testing.assert_allclose(mean, expected, rtol=0, atol=error_atol)


def write_text_model(folder: Path, **files: str) -> None:
    contents = {
        "cameras": "# c\n7 PINHOLE 640 480 7.0e+002 690 330 236\n",
        "images": "9 1 0 0 0 0 0 0 7 my photo é.jpg \n10 20 -1 30 40 1234567890123456789\n"
        "4 2 0 0 0 1e-002 0 0 7 b.jpg\n\n",
        "points3D": "1234567890123456789 1 2 3 4 5 6 -1 9 1\n",
    }
    for name, text in (contents | files).items():
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def test_text_habits_of_other_programs(tmp_path):
    write_text_model(tmp_path)
    model = read_colmap_model(tmp_path)
    assert [view.name for view in model.reconstruction.views] == ["b.jpg", "my photo é.jpg"]
    assert model.point_ids.tolist() == [1234567890123456789]
    np.testing.assert_array_equal(model.reconstruction.observations.pixels, [[30, 40]])
    np.testing.assert_array_equal(model.reconstruction.pose_of(0).R, np.eye(3))
    text = (tmp_path / "images.txt").read_text(encoding="utf-8")
    (tmp_path / "images.txt").write_bytes(text.replace("\n", "\r\n").encode())
    assert [view.name for view in read_colmap(tmp_path).views] == ["b.jpg", "my photo é.jpg"]


def test_tracks_of_images_without_keypoints_are_dropped_and_counted(tmp_path, caplog):
    write_text_model(tmp_path, points3D="5 1 2 3 4 5 6 0.5 9 1 4 0\n")
    assert len(read_colmap(tmp_path).observations) == 1
    assert "1 track elements dropped" in caplog.text


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"cameras": "7 PINHOLE 640 480 700 690 330"}, "cameras.txt, line 1: camera 7: PINHOLE has 4 parameters"),
        ({"cameras": "7 PINHOLE 640 480 0 690 330 236"}, "line 1: camera 7: focal length must be positive"),
        ({"cameras": "7 PINHOLE 640 480 700,5 690 330 236"}, "line 1: not a number"),
        ({"cameras": "7 EUCM 640 480 1 1 1 1 1 1"}, "EUCM is not supported"),
        ({"cameras": "7 PINHOLE 640"}, "line 1: a camera needs"),
        ({"cameras": "7 SIMPLE_PINHOLE 0 480 1 1 1"}, "0 x 480"),
        ({"cameras": "8 SIMPLE_PINHOLE 640 480 1 1 1"}, "has camera 7, which the model lacks"),
        ({"images": "9 1 0 0 0 0 0 0 7\n\n"}, "images.txt, line 1: an image needs"),
        ({"images": "9 0 0 0 0 0 0 0 7 a\n\n"}, "line 1: image 9: a quaternion is zero"),
        ({"images": "9 1e200 0 0 0 0 0 0 7 a\n\n"}, "line 1: image 9: the quaternion of a is no rotation"),
        ({"images": "9 1 0 0 0 nan 0 0 7 a\n\n"}, "line 1: image 9: the pose of a is not finite"),
        ({"images": "9 1 0 0 0 0 0 0 7 a\n1 2\n"}, "line 2: keypoints are x, y"),
        ({"images": "9 1 0 0 0 0 0 0 7 a\n1 inf -1\n"}, "keypoint 0 of a is not finite"),
        ({"images": "9 1 0 0 0 0 0 0 7 a\n1 2 3.5\n"}, "line 2: not a whole number"),
        ({"images": "9 1 0 0 0 0 0 0 7 a\n\n9 1 0 0 0 0 0 0 7 b\n\n"}, "the same image id"),
        ({"images": "9 1 0 0 0 0 0 0 7 ../a\n\n"}, "leads out of the photo folder"),
        ({"points3D": "5 1 2 3 4 5 6 0.5 9"}, "points3D.txt, line 1: a point needs"),
        ({"points3D": "5 1 2 3 4 5 256 0.5"}, "line 1: r g b"),
        ({"points3D": "5 1 2 nan 4 5 6 0.5"}, "point 5 is not finite"),
        ({"points3D": "5 1 2 3 4 5 6 0.5 9 2"}, "image 9, which has 2 keypoints, not number 2"),
        ({"points3D": "5 1 2 3 4 5 6 0.5 3 0"}, "image 3, which the model lacks"),
        ({"points3D": "5 1 2 3 4 5 6 0.5\n5 1 2 3 4 5 6 0.5"}, "two points have the same id"),
    ],
)
def test_wrong_text_models_say_where_and_why(tmp_path, files, message):
    write_text_model(tmp_path, **files)
    with pytest.raises(InputError, match=message) as caught:
        read_colmap(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_counts_are_compared_with_the_bytes_left(tmp_path):
    write_colmap(make_scene().truth, tmp_path)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        path = tmp_path / name
        original = path.read_bytes()
        path.write_bytes(struct.pack("<Q", 2**63) + original[8:])
        with pytest.raises(InputError, match=f"{name}, byte 0: 9223372036854775808 .* do not fit"):
            read_colmap(tmp_path)
        path.write_bytes(original)
    points = bytearray((tmp_path / "points3D.bin").read_bytes())
    points[8 + 43 : 8 + 51] = struct.pack("<Q", 2**40)
    (tmp_path / "points3D.bin").write_bytes(points)
    with pytest.raises(InputError, match=r"points3D.bin, byte 8: a track of 1099511627776 keypoints"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("suffix", ["bin", "txt"])
@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_damaged_models_end_in_an_input_error_or_a_sound_model(tmp_path, stem, suffix):
    name = f"{stem}.{suffix}"
    write_colmap(make_scene(num_points=12).truth, tmp_path, binary=suffix == "bin")

    def check(model):
        assert np.isfinite(model.points.xyz).all()
        assert model.reprojections().shape == (len(model.observations), 2)

    with np.errstate(all="ignore"):
        _, refused = check_mutations(tmp_path / name, lambda: read_colmap(tmp_path), check, count=300)
    assert refused > 30


def test_every_truncation_of_a_binary_file_is_noticed(tmp_path):
    scene = synthesize(SceneOptions(num_cameras=2, num_points=2), np.random.default_rng(0))
    write_colmap(scene.truth, tmp_path)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        original = (tmp_path / name).read_bytes()
        for length in range(len(original)):
            (tmp_path / name).write_bytes(original[:length])
            with pytest.raises(InputError, match=name):
                read_colmap(tmp_path)
        (tmp_path / name).write_bytes(original)


def test_models_are_found_below_the_folder_and_binary_wins(tmp_path):
    truth = make_scene().truth
    write_colmap(truth, tmp_path / "run" / "sparse" / "0")
    assert_same(read_colmap(tmp_path / "run"), truth)
    write_text_model(tmp_path / "run" / "sparse" / "0")
    assert_same(read_colmap(tmp_path / "run"), truth)
    with pytest.raises(InputError, match="readers prefer"):
        write_colmap(truth, tmp_path / "run" / "sparse" / "0", binary=False)
    with pytest.raises(InputError, match="no COLMAP model"):
        read_colmap(tmp_path)


def test_names_that_cannot_be_written_are_refused(tmp_path):
    truth = make_scene().truth
    spaced = replace(truth, views=(replace(truth.views[0], name="my photo.jpg"), *truth.views[1:]))
    write_colmap(spaced, tmp_path / "binary")
    assert read_colmap(tmp_path / "binary").views[0].name == "my photo.jpg"
    with pytest.raises(InputError, match="has blanks"):
        write_colmap(spaced, tmp_path / "text", binary=False)
    for name in ("../../.ssh/x", "/etc/x", "C:\\x", "a\nb", "a\0b", "", "x" * 5000, "a/../../b"):
        bad = replace(truth, views=(replace(truth.views[0], name=name), *truth.views[1:]))
        with pytest.raises(InputError, match="name"):
            write_colmap(bad, tmp_path / "bad")
    assert not (tmp_path / "bad").exists()


def test_a_keypoint_cannot_show_two_points(tmp_path):
    truth = make_scene().truth
    o = truth.observations
    keypoint = np.where(o.view == 0, 0, o.keypoint)
    with pytest.raises(ValueError, match="shows two points"):
        write_colmap(replace(truth, observations=replace(o, keypoint=keypoint)), tmp_path)
