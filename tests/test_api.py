"""The Python API as the README shows it, run for real on photos of the synthetic house."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fieldstone as fs
from fieldstone.io.models.colmap import read_colmap
from fieldstone.io.shapes.ply import read_points

ROOT = Path(__file__).resolve().parents[1]


def python_of_readme() -> str:
    """The section of the README that shows the API."""
    return (ROOT / "README.md").read_text().split("```python\n")[1].split("```")[0]


@pytest.fixture(scope="module")
def photos(house_photos) -> Path:
    """Six photos of a house, 320 x 240."""
    return house_photos


@pytest.fixture(scope="module")
def events() -> list[fs.Progress]:
    """What the stages of `scene` report."""
    return []


@pytest.fixture(scope="module")
def scene(photos, events) -> fs.Scene:
    """Of the photos, in memory."""
    return fs.reconstruct(photos, on_progress=events.append)


@pytest.fixture(scope="module")
def field(scene) -> fs.Field:
    """Of the scene, in memory: as good as one second allows."""
    return fs.train(scene, budget_s=1, hold_out=("house_02.jpg",))


def test_the_lines_of_the_readme_run(photos, tmp_path, monkeypatch):
    shutil.copytree(photos, tmp_path / "photos")
    monkeypatch.chdir(tmp_path)
    code = python_of_readme().replace("budget_s=60", "budget_s=1")
    assert code.count("budget_s=1") == 1
    names: dict = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["scene"].summary.registered == 6
    assert names["view"].rgb.shape == (240, 320, 3)
    assert (tmp_path / "house.glb").stat().st_size > 1000
    assert (tmp_path / "out" / "checkpoint.safetensors").is_file()


def test_a_scene_tells_of_every_photo_and_leaves_no_file(scene, photos):
    assert scene.summary.registered == len(scene.photos) == len(scene.model.registered()) == 6
    assert set(scene.verdicts) == {path.name for path in photos.iterdir()}
    assert all(verdict.startswith("registered: ") for verdict in scene.verdicts.values())
    assert scene.graph is not None
    assert scene.graph.names == tuple(sorted(scene.verdicts))
    tried = [note.split()[1] for note in scene.notes if note.startswith("calibration ")]
    assert tried == [trial.model for trial in scene.calibration]
    errors = scene.model.reprojection_errors()
    assert scene.summary.mean_px == pytest.approx(float(errors.mean()))
    assert {path.suffix for path in photos.iterdir()} == {".jpg"}


def test_every_stage_reports_how_far_it_is(scene, events):
    stages = list(dict.fromkeys(event.stage for event in events))
    assert stages[0] == "finding features"
    assert "registering photos" in stages
    for stage in stages:
        done = [event.done for event in events if event.stage == stage]
        assert done == sorted(done)
        assert all(event.total is None or event.done <= event.total for event in events)


def test_a_saved_scene_opens_as_it_was(scene, tmp_path):
    scene.save(tmp_path / "out")
    opened = fs.open_scene(tmp_path / "out")
    assert opened.photos.names == scene.photos.names
    assert opened.photos.paths == scene.photos.paths
    np.testing.assert_allclose(opened.photos.cam_from_world.t, scene.photos.cam_from_world.t, atol=1e-12)
    assert opened.record == json_round_trip(scene, opened)
    assert read_colmap(tmp_path / "out").observations.pixels.shape == scene.model.observations.pixels.shape
    assert len(read_points(tmp_path / "out" / "points.ply").xyz) == len(scene.model.points)
    assert (tmp_path / "out" / "report.html").is_file()


def json_round_trip(scene, opened):
    """The record of a scene with what only saving knows."""
    from dataclasses import replace

    seconds, folder = opened.record.seconds, opened.record.photos_folder
    return replace(scene.record, seconds=seconds, photos_folder=folder)


def test_a_field_learned_in_memory_is_that_of_the_saved_scene(scene, tmp_path):
    """Files hold rotations as quaternions: the last bits of a pose differ, and nothing else."""
    plan = tmp_path / "plan.json"
    plan.write_text(json.dumps({"finest": 24, "steps": [6] * 8, "num_chunks": 2, "samples_per_chunk": 256}))
    scene.save(tmp_path / "out", report=False)
    in_memory = fs.train(scene, plan=plan)
    from_disk = fs.train(tmp_path / "out", plan=plan)
    assert in_memory.photos.names == from_disk.photos.names
    assert in_memory.header.cameras == from_disk.header.cameras
    np.testing.assert_allclose(in_memory.photos.cam_from_world.R, from_disk.photos.cam_from_world.R, atol=1e-12)
    np.testing.assert_allclose(in_memory.frame.far, from_disk.frame.far, rtol=1e-9)
    assert in_memory.metrics is not None
    assert from_disk.metrics is not None
    assert in_memory.metrics.psnr == pytest.approx(from_disk.metrics.psnr, abs=0.1)


def test_a_field_renders_and_comes_back_from_disk(field, scene, tmp_path):
    assert field.metrics is not None
    assert list(field.metrics.views) == ["house_02"]
    camera, pose = scene.photos.camera_of(2), scene.photos.pose_of(2)
    view = field.render(camera, pose)
    assert view.rgb.shape == (240, 320, 3)
    assert view.depth.shape == view.opacity.shape == (240, 320)
    field.save(tmp_path / "out")
    again = fs.open_field(tmp_path / "out")
    np.testing.assert_array_equal(again.render(camera, pose).rgb, view.rgb)
    assert again.header == field.header
    assert again.metrics == field.metrics
    film = again.film(frames=2, size=64)
    assert len(film) == 2
    assert film.save(tmp_path / "walk.gif").stat().st_size > 100
    assert fs.render(tmp_path / "out", frames=2, size=64, format="gif") == tmp_path / "out" / "renders" / "orbit.gif"


def test_options_that_make_no_sense_are_named(photos):
    with pytest.raises(fs.InputError, match="`max_image_size` must be at least 1, got 0"):
        fs.reconstruct(photos, max_image_size=0)
    with pytest.raises(fs.InputError, match="`budget_s` must be positive"):
        fs.train(photos, budget_s=-1.0)
    with pytest.raises(fs.InputError, match="`plan` belongs to the fast field"):
        fs.train(photos, field="tiny", plan=Path("plan.json"))
    with pytest.raises(TypeError, match="sizes"):
        fs.train(photos, sizes=3)


def test_nothing_is_loaded_before_it_is_used():
    code = "import sys, fieldstone; print([m for m in ('numpy', 'numba', 'cv2', 'torch', 'tyro') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_the_verbs_are_functions_whatever_was_imported():
    """A folder of the package must not hide a verb of the same name."""
    code = (
        "import importlib, pkgutil, fieldstone as fs\n"
        "for m in pkgutil.iter_modules(fs.__path__, 'fieldstone.'): importlib.import_module(m.name)\n"
        "print([name for name in ('reconstruct', 'train', 'render', 'open_scene') if not callable(getattr(fs, name))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
