"""What people do wrong, or photos that are no good: a sensible field, or one clear error."""

import json

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import write_photo
from fieldstone.run import grid_planning, grid_run
from fieldstone.run.folder import RunFolder
from grid_scenes import ball_photos
from training import trained

STEPS = {"finest": 24, "steps": [6] * 8, "num_chunks": 2, "samples_per_chunk": 256}


def write_scene(folder, *, edit=lambda pixels: pixels, poses=None):
    """Ten photos of a ball as a transforms.json, with pixels that a test may change."""
    photos = ball_photos(10)
    frames = []
    for k, (name, pixels) in enumerate(zip(photos.posed.names, edit(photos.pixels), strict=True)):
        if pixels is not None:
            write_photo(folder / f"{name}.png", pixels)
        pose = photos.posed.pose_of(k) if poses is None else poses[k]
        matrix = pose.inverse().matrix() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{name}.png", "transform_matrix": matrix.tolist()})
    (folder / "plan.json").write_text(json.dumps(STEPS))
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return folder


def train(folder, **options):
    return trained(folder, folder / "out", plan=folder / "plan.json", threads=1, **options)


def one_color(photos):
    return [np.full_like(pixels[..., :3], 77) for pixels in photos]


def mixed_alpha(photos):
    return [pixels if k % 2 else pixels[..., :3] for k, pixels in enumerate(photos)]


def some_missing(photos):
    return [None if k in (2, 3) else pixels for k, pixels in enumerate(photos)]


def several_sizes(photos):
    return [pixels if k % 2 else pixels[::2, ::2] for k, pixels in enumerate(photos)]


@pytest.mark.parametrize("edit", [one_color, mixed_alpha, some_missing, several_sizes])
def test_odd_photos_still_make_a_field(tmp_path, edit):
    metrics = train(write_scene(tmp_path, edit=edit))
    assert metrics.psnr is not None
    assert np.isfinite(metrics.psnr)
    if edit is one_color:
        # There is nothing to learn but one colour, and the background has it.
        assert metrics.psnr > 25


def test_photos_of_one_pixel_are_refused(tmp_path):
    folder = write_scene(tmp_path, edit=lambda photos: [pixels[:1, :1] for pixels in photos])
    with pytest.raises(InputError, match="smaller than 11"):
        train(folder)


def test_photos_without_a_common_place_are_refused_or_learned(tmp_path):
    """Cameras side by side that look the same way: their axes never meet."""
    photos = ball_photos(10)
    pose = photos.posed.pose_of(0)
    poses = [Rigid3(pose.R, pose.t + [0.5 * k, 0.0, 0.0]) for k in range(10)]
    metrics = train(write_scene(tmp_path, edit=lambda photos: [pixels[..., :3] for pixels in photos], poses=poses))
    assert metrics.psnr is not None
    assert np.isfinite(metrics.psnr)


def test_cameras_at_one_place_are_refused(tmp_path):
    photos = ball_photos(10)
    poses = [Rigid3(pose.R, np.zeros(3)) for pose in photos.posed.cam_from_world]
    with pytest.raises(InputError, match="one place"):
        train(write_scene(tmp_path, poses=poses))


def test_a_budget_of_a_second_makes_a_field(tmp_path):
    folder = write_scene(tmp_path)
    metrics = trained(folder, folder / "out", budget_s=1.0, threads=1)
    assert metrics.steps >= 1
    assert (folder / "out" / "checkpoint.safetensors").is_file()
    assert (folder / "out" / "preview.png").is_file()


def test_too_little_memory_is_an_error(tmp_path):
    folder = write_scene(tmp_path)
    with pytest.raises(InputError, match="`memory`"):
        trained(folder, folder / "out", budget_s=1.0, threads=1, memory=1e-5)


def test_less_memory_means_coarser_grids(tmp_path):
    folder = write_scene(tmp_path)
    metrics = trained(folder, folder / "out", budget_s=1.0, threads=1, memory=1e-3)
    # 48 bytes a vertex.
    assert metrics.plan is not None
    assert 48 * metrics.plan["finest"] ** 3 < 2e-3 * 2**30


def test_a_full_disk_at_checkpoint_time_is_one_line(tmp_path, monkeypatch, capsys):
    folder = write_scene(tmp_path)

    def full(folder, header, tensors):
        raise OSError(28, "No space left on device", str(folder.checkpoint))

    monkeypatch.setattr(RunFolder, "write_checkpoint", full)
    arguments = ["train", str(folder), "-o", str(folder / "out"), "--plan", str(folder / "plan.json"), "--threads", "1"]
    assert main(arguments) == 5
    error = capsys.readouterr().err
    assert "No space left" in error
    assert error.count("\n") == 1


def test_too_little_memory_for_numpy_is_one_line(tmp_path, monkeypatch, capsys):
    def too_much(*arguments, **options):
        raise MemoryError

    monkeypatch.setattr(grid_planning, "prepare_grid_training", too_much)
    monkeypatch.setattr(grid_run, "compile_kernels", lambda *arguments: None)
    folder = write_scene(tmp_path)
    assert main(["train", str(folder), "-o", str(folder / "out"), "--threads", "1"]) == 5
    error = capsys.readouterr().err
    assert "out of memory" in error
    assert error.count("\n") == 1


def test_a_held_out_photo_of_another_size_is_found_before_training(tmp_path, monkeypatch):
    folder = write_scene(tmp_path)
    monkeypatch.setattr(
        grid_planning, "prepare_grid_training", lambda *arguments, **options: pytest.fail("began to train")
    )
    monkeypatch.setattr(grid_run, "compile_kernels", lambda *arguments: None)
    scene = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps({**scene, "w": 40, "h": 32}))
    write_photo(folder / "r_8.png", np.zeros((50, 60, 4), np.uint8))
    with pytest.raises(InputError, match="60x50"):
        train(folder)


def test_a_checkpoint_of_another_kind_is_refused(tmp_path):
    folder = write_scene(tmp_path)
    (folder / "out").mkdir()
    (folder / "out" / "checkpoint.safetensors").write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="checkpoint"):
        train(folder)
