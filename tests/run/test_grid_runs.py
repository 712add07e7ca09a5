import itertools
import json
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import write_photo
from fieldstone.run import grid_stages
from fieldstone.run.folder import RunFolder
from fieldstone.run.grid_planning import size_in_memory
from fieldstone.run.train import train
from fieldstone.scene.photos import posed_photos
from grid_scenes import ball_photos, psnr_of_one_color
from training import at_step, trained

CAMERA_12_MP = Camera("SIMPLE_PINHOLE", 4000, 3000, np.array([3000.0, 2000.0, 1500.0]))


@pytest.fixture(scope="module")
def ball_folder(tmp_path_factory):
    """The ball in the Blender format: 9 photos to train on, one to test."""
    folder = tmp_path_factory.mktemp("ball")
    photos = ball_photos(10)
    camera = photos.posed.camera_of(0)
    angle = 2 * np.arctan(0.5 * camera.width / camera.focal[0])
    for split, part in {"train": range(1, 10), "test": range(1)}.items():
        frames = []
        for v in part:
            name, pose = photos.posed.names[v], photos.posed.pose_of(v)
            write_photo(folder / split / f"{name}.png", photos.pixels[v])
            world_from_cam = np.eye(4)
            world_from_cam[:3, :3] = pose.R.T @ np.diag([1.0, -1, -1])
            world_from_cam[:3, 3] = pose.target_origin_in_source()
            frames.append({"file_path": f"./{split}/{name}", "transform_matrix": world_from_cam.tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return folder


def checkpoint_bytes(folder):
    return (folder / "checkpoint.safetensors").read_bytes()


def write_plan(path, steps=5):
    path.write_text(json.dumps({"finest": 32, "steps": [steps] * 8, "num_chunks": 2, "samples_per_chunk": 512}))
    return path


def test_a_budget_is_kept_and_leaves_its_plan(ball_folder, tmp_path, monkeypatch):
    """By a clock that goes on by a hundredth of a second whenever it is read, so that the machine has no say."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: 0.01 * next(ticks))
    metrics = trained(ball_folder, tmp_path / "out", budget_s=3.0, threads=1)
    assert 1.5 < metrics.seconds <= 3.0
    plan = metrics.plan
    assert plan is not None
    assert metrics.steps == min(sum(plan["steps"]), plan["stop_after"] or sum(plan["steps"]))
    # Half the error of the best single colour.
    assert metrics.psnr is not None
    assert metrics.psnr > psnr_of_one_color(ball_photos(10), 0) + 20 * np.log10(2)
    assert (tmp_path / "out" / "renders" / "test" / "r_0.png").is_file()
    assert json.loads((tmp_path / "out" / "plan.json").read_text()) == json.loads(json.dumps(plan))


def test_a_run_out_of_time_is_saved_once(ball_folder, tmp_path, monkeypatch):
    saved = []
    write = RunFolder.write_checkpoint
    monkeypatch.setattr(RunFolder, "write_checkpoint", lambda *of: [saved.append(of[0].path), write(*of)])
    metrics = trained(ball_folder, tmp_path / "out", budget_s=0.01, threads=1)
    assert metrics.plan is not None
    assert metrics.plan["stop_after"] == metrics.steps < sum(metrics.plan["steps"])
    assert saved == [tmp_path / "out"]


def test_what_is_old_is_saved_at_the_end_of_a_stage(ball_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(grid_stages, "SAVED_AFTER_S", 0.0)
    steps, write = [], RunFolder.write_checkpoint

    def counted(folder, header, tensors):
        steps.append(int(tensors["state.step"]))
        write(folder, header, tensors)

    monkeypatch.setattr(RunFolder, "write_checkpoint", counted)
    trained(ball_folder, tmp_path / "out", plan=write_plan(tmp_path / "plan.json"), threads=1)
    assert steps == [5, 10, 15, 20, 25, 30, 35, 40]


def test_the_same_plan_gives_the_same_bytes_however_interrupted(ball_folder, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    trained(ball_folder, tmp_path / "a", plan=plan, threads=1)
    trained(ball_folder, tmp_path / "b", plan=plan, steps=7, threads=2)
    assert checkpoint_bytes(tmp_path / "a") != checkpoint_bytes(tmp_path / "b")

    with pytest.raises(KeyboardInterrupt):
        trained(ball_folder, tmp_path / "b", plan=plan, threads=2, on_progress=at_step(18, KeyboardInterrupt))
    trained(ball_folder, tmp_path / "b", plan=plan, threads=2)
    assert checkpoint_bytes(tmp_path / "a") == checkpoint_bytes(tmp_path / "b")


def test_a_run_goes_on_by_its_own_plan(ball_folder, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    out = tmp_path / "out"
    trained(ball_folder, out, plan=plan, steps=7, threads=1)
    other = write_plan(tmp_path / "other.json", steps=6)
    with pytest.raises(InputError, match="another plan"):
        trained(ball_folder, out, plan=other, threads=1)
    metrics = trained(ball_folder, out, budget_s=0.01, threads=1)
    assert metrics.steps == 40
    assert metrics.plan is not None
    assert metrics.plan["stop_after"] is None
    assert metrics.seconds > json.loads((out / "curve.json").read_text())[6]["seconds"]
    trained(ball_folder, tmp_path / "whole", plan=plan, threads=1)
    assert checkpoint_bytes(out) == checkpoint_bytes(tmp_path / "whole")


def test_refined_poses_stay_refined_when_a_run_goes_on(ball_folder, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    settings = json.loads(plan.read_text())
    plan.write_text(json.dumps({**settings, "refine_poses": True}))
    trained(ball_folder, tmp_path / "whole", plan=plan, threads=1)
    trained(ball_folder, tmp_path / "out", plan=plan, steps=22, threads=1)
    trained(ball_folder, tmp_path / "out", threads=1)
    assert checkpoint_bytes(tmp_path / "out") == checkpoint_bytes(tmp_path / "whole")


def test_photos_are_as_large_as_memory_allows():
    photos = posed_photos(
        [f"{k}" for k in range(20)], [CAMERA_12_MP], np.zeros(20, int), Rigid3.stack([Rigid3.identity()] * 20)
    )
    size = size_in_memory(photos, 4.0)
    assert 36 * 20 * size * (0.75 * size) == pytest.approx(0.75 * 4 * 2**30, rel=1e-2)
    assert size_in_memory(photos.select([0]), 4.0) == 4000
    assert size_in_memory(photos, 1e-6) == 200


def test_train_and_render_as_typed(ball_folder, tmp_path, capsys):
    out = tmp_path / "out"
    plan = write_plan(tmp_path / "plan.json")
    assert main(["train", str(ball_folder), "-o", str(out), "--plan", str(plan), "--no-alpha", "--threads", "1"]) == 0
    assert "PSNR" in capsys.readouterr().out
    whole = ["train", str(ball_folder), "-o", str(tmp_path / "whole"), "--plan", str(plan), "--hold-out", "none"]
    assert main([*whole, "--threads", "1"]) == 0
    assert "no photo was held out" in capsys.readouterr().out
    for frames in (3, 2):
        assert main(["render", str(out), "--format", "png", "--frames", str(frames), "--threads", "1"]) == 0
    assert sorted(path.name for path in (out / "renders" / "orbit").iterdir()) == ["0000.png", "0001.png"]
    given = tmp_path / "orbit.json"
    given.write_text(json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]}))
    assert main(["render", str(out), "--format", "png", "--path", str(given), "--threads", "1"]) == 0
    assert (out / "renders" / "orbit" / "0001.png").is_file()
    assert (out / "renders" / "orbit_json" / "0000.png").is_file()


def test_paths_start_from_refined_poses(ball_folder, tmp_path):
    field = train(ball_folder, plan=write_plan(tmp_path / "plan.json"), steps=1, threads=1)
    given = field.photos.cam_from_world
    moved = np.random.default_rng(0).normal(scale=0.01, size=(len(given.t), 6))
    refined = replace(field, tensors={**field.tensors, "state.moved": moved}).photos.cam_from_world
    for v in range(len(moved)):
        expected = given[v].retract(moved[v])
        np.testing.assert_allclose(refined.R[v], expected.R, atol=1e-12)
        np.testing.assert_allclose(refined.t[v], expected.t, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"budget_s": 0.0}, "budget"),
        ({"plan": "nowhere.json"}, "nowhere.json"),
    ],
)
def test_mistakes_are_named(ball_folder, tmp_path, arguments, message):
    if "plan" in arguments:
        arguments = {"plan": tmp_path / arguments["plan"]}
    with pytest.raises(InputError, match=message):
        trained(ball_folder, tmp_path / "out", **arguments)


def test_the_other_fields_know_no_plan(ball_folder, tmp_path, capsys):
    assert main(["train", str(ball_folder), "-o", str(tmp_path / "out"), "--field", "tiny", "--no-alpha"]) == 3
    assert "--alpha belongs to the fast field" in capsys.readouterr().err


def test_a_run_may_change_its_device(ball_folder, tmp_path, caplog):
    """torch's own CPU stands for a GPU here; where it left off, the kernels go on."""
    pytest.importorskip("torch")
    plan, out = write_plan(tmp_path / "plan.json", steps=12), tmp_path / "out"
    first = trained(ball_folder, out, plan=plan, device="cpu:0", threads=1, steps=60)
    assert "never on a GPU" in caplog.text
    assert first.device == "cpu:0"
    last = trained(ball_folder, out, plan=plan, threads=1)
    assert last.device == "cpu"
    assert last.steps == 96
    assert last.psnr is not None
    assert first.psnr is not None
    assert last.psnr > first.psnr
    assert len(json.loads((out / "curve.json").read_text())) == 96


def test_a_budget_becomes_a_plan_on_every_device(ball_folder, tmp_path):
    pytest.importorskip("torch")
    metrics = trained(ball_folder, tmp_path / "out", budget_s=2.0, device="cpu:0", threads=1)
    plan = metrics.plan
    assert plan is not None
    assert metrics.steps == min(sum(plan["steps"]), plan["stop_after"] or sum(plan["steps"])) > 0


def test_a_device_without_torch_says_what_to_install(ball_folder, tmp_path, monkeypatch):
    torch_users = ("fieldstone.field.nerf.", "fieldstone.field.grid_torch.")
    for name in [name for name in sys.modules if name.startswith(torch_users)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(InputError, match=r"fast field on cuda needs torch: pip install 'fieldstone\[torch\]'"):
        trained(ball_folder, tmp_path / "out", budget_s=1.0, device="cuda", threads=1)
    assert not (tmp_path / "out").exists()
