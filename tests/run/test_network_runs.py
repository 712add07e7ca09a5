"""The verbs `train` and `render`, on a ball that is cheap to photograph and to learn."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import psnr, ssim
from fieldstone.field.base.training import PRESETS, TINY
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import look_at
from fieldstone.io.files.checkpoint import read_checkpoint, write_checkpoint
from fieldstone.io.images.photos import read_photo, write_photo
from fieldstone.io.models.colmap import write_colmap
from fieldstone.run.field_input import read_ray_dataset, view_labels
from fieldstone.run.folder import RunFolder
from fieldstone.run.render import render
from fieldstone.scene.rays import rays_from_view
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from grid_scenes import photographs, psnr_of_one_color
from training import at_step
from training import trained as trained_with


def trained(source, out, **settings):
    return trained_with(source, out, **{"field": "tiny", **settings})


CAMERA = Camera("SIMPLE_PINHOLE", 20, 16, np.array([24.0, 10.0, 8.0]))


def ball_photo(pose, *, center=(0.0, 0.0, 0.0), radius=1.0):
    """RGBA of a ball coloured by its normal."""
    rays = rays_from_view(CAMERA, pose)
    origins = rays.origins - center
    b = np.sum(origins * rays.directions, axis=1)
    discriminant = b**2 - np.sum(origins**2, axis=1) + radius**2
    normals = (origins + (-b - np.sqrt(np.maximum(discriminant, 0)))[:, None] * rays.directions) / radius
    rgba = np.concatenate([0.5 + 0.5 * normals, (discriminant > 0)[:, None]], axis=1)
    return np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8).reshape(16, 20, 4)


def ring(n, radius=4.0, center=(0.0, 0.0, 0.0)):
    up = np.array([0.0, 0, 1])
    for angle in 2 * np.pi * np.arange(n) / n:
        position = np.array(center) + radius * np.array([np.cos(angle), np.sin(angle), 0.3])
        yield look_at(position, np.array(center), up)


def write_blender_folder(folder):
    for split, n in (("train", 6), ("test", 2)):
        frames = []
        for k, pose in enumerate(ring(n)):
            name = f"./{split}/r_{k}"
            write_photo(folder / f"{name}.png", ball_photo(pose))
            world_from_cam = pose.inverse()
            matrix = np.eye(4)
            matrix[:3, :3] = world_from_cam.R @ np.diag([1, -1, -1])
            matrix[:3, 3] = world_from_cam.t
            frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
        content = {"camera_angle_x": float(2 * np.arctan(10 / 24)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


def write_colmap_folder(folder, photos, n=9):
    """A model of a ball of radius 3 at (10, 0, 0), with points on the ball, and its photos in another folder."""
    center = np.array([10.0, 0, 0])
    poses = list(ring(n, radius=12.0, center=center))
    points = center + 3.0 * np.random.default_rng(0).standard_normal((40, 3)) / np.sqrt(3)
    views = tuple(View(f"p{k}.png", 0, pose) for k, pose in enumerate(poses))
    point = np.repeat(np.arange(40), n)
    view = np.tile(np.arange(n), 40)
    observations = Observations(view, point.copy(), point, np.zeros((40 * n, 2)))
    model = Reconstruction((CAMERA,), views, Points(points, np.zeros((40, 3), dtype=np.uint8)), observations)
    write_colmap(model, folder / "sparse" / "0")
    for v in views:
        write_photo(photos / v.name, ball_photo(v.cam_from_world, center=center, radius=3.0)[..., :3])
    return folder


@pytest.fixture
def small_tiny(monkeypatch):
    """The preset `tiny`, small enough for a test."""
    options = replace(TINY, width=16, position_frequencies=3, direction_frequencies=1, num_samples=8)
    monkeypatch.setitem(PRESETS, "tiny", options)


pytestmark = pytest.mark.usefixtures("small_tiny")


def test_train_on_a_blender_folder(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    stages = []

    def hear(event):
        if event.stage not in stages:
            stages.append(event.stage)

    metrics = trained(source, out, steps=160, threads=1, on_progress=hear)
    assert metrics == RunFolder(out).read_metrics()
    assert stages == ["reading photos", "training", "rendering held-out views"]
    assert set(metrics.views) == {"r_0", "r_1"}
    assert metrics.steps == 160
    assert "8-bit" in metrics.protocol
    assert "2 held-out views of 20x16 pixels" in metrics.protocol
    # The numbers are those of the written images against the photos on white.
    for name, view in metrics.views.items():
        rendered = read_photo(out / "renders" / "test" / f"{name}.png").rgb / 255.0
        given = read_photo(source / "test" / f"{name}.png")
        assert given.alpha is not None
        alpha = given.alpha[..., None] / 255.0
        photo = given.rgb / 255.0 * alpha + 1 - alpha
        assert view.psnr == pytest.approx(psnr(rendered, photo), rel=1e-9)
        assert view.ssim == pytest.approx(ssim(rendered, photo), rel=1e-9)
    assert metrics.psnr == pytest.approx(np.mean([view.psnr for view in metrics.views.values()]))
    assert metrics.ssim == pytest.approx(np.mean([view.ssim for view in metrics.views.values()]))
    assert metrics.psnr is not None
    photos = [ball_photo(pose) for pose in ring(2)]
    table = photographs(CAMERA, list(ring(2)), photos)
    best_single_color = np.mean([psnr_of_one_color(table, k, np.ones(3)) for k in range(2)])
    assert metrics.psnr > best_single_color
    curve = json.loads((out / "curve.json").read_text())
    assert [point["step"] for point in curve] == list(range(1, 161))
    assert set(curve[0]) == {"step", "seconds", "loss", "psnr"}
    assert curve[-1]["psnr"] > curve[0]["psnr"]
    assert metrics.seconds == curve[-1]["seconds"]


def test_a_stopped_run_goes_on_to_the_same_bits(tmp_path):
    pytest.importorskip("torch")
    source = write_blender_folder(tmp_path / "in")
    trained(source, tmp_path / "whole", steps=7, threads=1)

    class Killed(BaseException):
        pass

    trained(source, tmp_path / "parts", steps=3, threads=2)
    with pytest.raises(Killed):
        trained(source, tmp_path / "parts", steps=7, threads=1, on_progress=at_step(5, Killed))
    trained(source, tmp_path / "parts", steps=7, threads=1)
    name = "checkpoint.safetensors"
    assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    whole, parts = (json.loads((tmp_path / run / "curve.json").read_text()) for run in ("whole", "parts"))
    assert [(p["step"], p["loss"]) for p in parts] == [(p["step"], p["loss"]) for p in whole]


def test_an_interrupted_run_keeps_its_steps(tmp_path):
    pytest.importorskip("torch")
    source = write_blender_folder(tmp_path / "in")

    with pytest.raises(KeyboardInterrupt):
        trained(source, tmp_path / "out", steps=7, threads=1, on_progress=at_step(2, KeyboardInterrupt))
    tensors, _ = read_checkpoint(tmp_path / "out" / "checkpoint.safetensors")
    assert tensors["state.step"] == 2


def test_the_budget_counts_earlier_runs(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    first = trained(source, out, budget_s=0.2, threads=1)
    assert first.seconds >= 0.2
    again = trained(source, out, budget_s=0.2, threads=1)
    assert again.steps == first.steps
    assert trained(source, out, budget_s=first.seconds + 0.1, threads=1).steps > first.steps


def test_another_run_in_the_same_folder_is_refused(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    trained(source, out, steps=1, threads=1)
    with pytest.raises(InputError, match="differs in: seed"):
        trained(source, out, steps=2, seed=1, threads=1)
    photo = next((source / "train").iterdir())
    write_photo(photo, np.zeros((16, 20, 4), dtype=np.uint8))
    with pytest.raises(InputError, match="differs in: photos"):
        trained(source, out, steps=2, threads=1)


def test_damaged_checkpoints_are_refused_and_kept(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    trained(source, out, steps=2, threads=1)
    path = out / "checkpoint.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    for run in (lambda: trained(source, out, steps=3, threads=1), lambda: render(out)):
        with pytest.raises(InputError, match="damaged or truncated checkpoint"):
            run()
    assert path.read_bytes() == whole[: len(whole) // 2]
    path.write_bytes(whole)
    (out / "curve.json").write_text("[{]")
    with pytest.raises(InputError, match=r"curve\.json"):
        trained(source, out, steps=3, threads=1)


def test_train_on_a_reconstruction(tmp_path):
    pytest.importorskip("torch")
    source = write_colmap_folder(tmp_path / "in", tmp_path / "photos")
    metrics = trained(source, tmp_path / "out", steps=2, threads=1, photos=tmp_path / "photos")
    # Nine photos by name: numbers 0 and 8 are held out.
    assert set(metrics.views) == {"p0", "p8"}
    tensors, _ = read_checkpoint(tmp_path / "out" / "checkpoint.safetensors")
    assert tensors["views.R"].shape == (7, 3, 3)
    film = render(tmp_path / "out", path="through", format="gif", frames=3, threads=1)
    assert film == tmp_path / "out" / "renders" / "through.gif"


def test_dataset_of_a_reconstruction(tmp_path):
    source, photos = write_colmap_folder(tmp_path / "in", tmp_path / "photos"), tmp_path / "photos"
    with pytest.raises(InputError, match="photos of the model are in none of"):
        read_ray_dataset(source, None, 100)
    (photos / "p3.png").unlink()
    (photos / "p4.png").write_bytes(b"no photo")
    dataset = read_ray_dataset(source, photos, 100)
    assert list(dataset.train.posed.names) == ["p1.png", "p2.png", "p5.png", "p6.png", "p7.png", "p8.png"]
    assert len(dataset.points_in_world) == 40
    # The ball has radius 3 and the cameras are 12.5 away: its front is within the range of the rays.
    scale = dataset.frame.normalized_from_world.scale
    assert dataset.frame.near / scale < 9.5
    assert dataset.frame.far / scale > 15.5
    for path in photos.iterdir():
        path.unlink()
    with pytest.raises(InputError, match="none of the 9 photos"):
        read_ray_dataset(source, photos, 100)


def test_folders_without_posed_photos_are_refused(tmp_path):
    with pytest.raises(InputError, match="no posed photos"):
        read_ray_dataset(tmp_path, None, 100)
    source = write_blender_folder(tmp_path / "in")
    with pytest.raises(InputError, match="smaller than 11 pixels"):
        read_ray_dataset(source, None, 12)


def test_render_formats(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    trained(source, out, steps=2, threads=1)
    done = []
    film = render(out, frames=4, threads=1, on_progress=lambda event: done.append((event.done, event.total)))
    assert film.name == "orbit.mp4"
    assert done == [(k, 4) for k in range(5)]
    folder = render(out, path="spiral", format="png", frames=2, size=40, threads=1)
    assert sorted(p.name for p in folder.iterdir()) == ["0000.png", "0001.png"]
    assert read_photo(folder / "0000.png").rgb.shape == (32, 40, 3)
    assert len(list(render(out, path="dataset", format="png", threads=1).iterdir())) == 6
    given = tmp_path / "walk.json"
    given.write_text(json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}] * 2}))
    assert render(out, path=str(given), format="gif", threads=1).name == "walk.gif"
    shown = render(out, path=str(given), format="png", show="confidence", frames=5, threads=1)
    assert shown.name == "walk_confidence"
    assert len(list(shown.iterdir())) == 5
    with pytest.raises(InputError, match="`path` sideways: give one of orbit"):
        render(out, path="sideways")
    with pytest.raises(InputError, match="at least 1"):
        render(out, frames=0)
    with pytest.raises(InputError, match="fieldstone train"):
        render(tmp_path)


def test_a_checkpoint_without_its_parts_is_refused(tmp_path):
    pytest.importorskip("torch")
    source, out = write_blender_folder(tmp_path / "in"), tmp_path / "out"
    trained(source, out, steps=1, threads=1)
    path = out / "checkpoint.safetensors"
    tensors, header = read_checkpoint(path)
    del tensors["state.parameters"]
    write_checkpoint(path, tensors, header)
    with pytest.raises(InputError, match="parameters"):
        render(out, frames=1, threads=1)


def test_without_torch_the_way_out_is_named(tmp_path, monkeypatch):
    source = write_blender_folder(tmp_path / "in")
    monkeypatch.setitem(sys.modules, "torch", None)
    torch_users = ("fieldstone.field.nerf.", "fieldstone.field.grid_torch.")
    for name in [name for name in sys.modules if name.startswith(torch_users)]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(InputError, match=r"pip install 'fieldstone\[torch\]'"):
        trained(source, tmp_path / "out", steps=1)
    assert not (tmp_path / "out").exists()


def test_labels_of_views():
    assert view_labels(["test/r_0", "test/r_10.png"]) == ["r_0", "r_10"]
    assert view_labels(["a/x.jpg", "b/x.jpg"]) == ["a/x", "b/x"]
    assert view_labels(["x.jpg", "x.png", "y.png"]) == ["x.jpg", "x.png", "y"]
    assert view_labels([]) == []
