"""`train` on a reconstruction: known points, exposures and masks through the whole pipeline."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import psnr
from fieldstone.field.grid_training.budget import first_plan
from fieldstone.geometry.camera import image_from_cam
from fieldstone.io.files.checkpoint import read_checkpoint
from fieldstone.io.images.photos import read_photo, write_photo
from fieldstone.io.models.colmap import write_colmap
from fieldstone.run.scene import open_scene
from fieldstone.run.train import train
from fieldstone.scene.reconstruction import Points, Reconstruction, View
from fieldstone.scene.tracks import Observations
from grid_scenes import CAMERA, RADIUS, ball_photos
from training import trained

WHITE_ROWS = 24


@pytest.fixture(scope="module")
def ball_model(tmp_path_factory):
    """A model of the ball before black, photographed nine times, and masks that leave the lower rows out."""
    folder, rng = tmp_path_factory.mktemp("model"), np.random.default_rng(0)
    photos = ball_photos(9)
    names = photos.posed.names
    xyz = rng.normal(size=(400, 3))
    xyz *= RADIUS / np.linalg.norm(xyz, axis=1, keepdims=True)
    rows = []
    mask = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    mask[:WHITE_ROWS] = 255
    for v, (name, rgba) in enumerate(zip(names, photos.pixels, strict=True)):
        rgb = np.where(rgba[..., 3:] > 127, rgba[..., :3], 20)
        write_photo(folder / "images" / f"{name}.png", rgb.astype(np.uint8))
        write_photo(folder / "white" / f"{name}.png", mask)
        facing = np.einsum("ni,ni->n", xyz, photos.posed.centers()[v] - xyz) > 0.3
        pixels = image_from_cam(CAMERA, photos.posed.pose_of(v).apply(xyz))
        rows += [(p, v, *pixels[p]) for p in np.flatnonzero(facing)]
    point, view, x, y = (np.array(column) for column in zip(*sorted(rows), strict=True))
    keypoint = np.zeros(len(point), dtype=np.int64)
    for v in range(len(photos)):
        keypoint[view == v] = np.arange(np.count_nonzero(view == v))
    model = Reconstruction(
        (CAMERA,),
        tuple(View(f"{name}.png", 0, photos.posed.pose_of(v)) for v, name in enumerate(names)),
        Points(xyz, np.zeros((400, 3), np.uint8)),
        Observations(view, keypoint, point, np.stack([x, y], axis=1)),
    )
    write_colmap(model, folder / "sparse" / "0")
    return folder


def write_plan(path):
    settings = json.loads(first_plan(24, 20.0, bounded=False).to_json())
    path.write_text(json.dumps(settings | {"steps": [12] * 8, "num_chunks": 2, "samples_per_chunk": 512}))
    return path


def test_nothing_is_learned_from_what_masks_hide(ball_model, tmp_path):
    """Photos that differ only under the masks train the same field, bit by bit; without masks they do not."""
    plan = write_plan(tmp_path / "plan.json")
    painted = shutil.copytree(ball_model, tmp_path / "painted")
    for path in (painted / "images").iterdir():
        pixels = read_photo(path).rgb.copy()
        # Not the row beside the mask's edge: colours at known points are interpolated from both sides of it.
        pixels[WHITE_ROWS + 1 :] = 255 - pixels[WHITE_ROWS + 1 :]
        write_photo(path, pixels)
    names = (ball_model.name, painted.name)
    for kind, masks in {"masked": Path("white"), "bare": None}.items():
        for folder in (ball_model, painted):
            out = tmp_path / kind / folder.name
            trained(folder, out, plan=plan, threads=1, masks=masks and folder / masks, steps=30)
    for kind, same in {"masked": True, "bare": False}.items():
        # The header names the folder; tensors are what was learned.
        one, other = (read_checkpoint(tmp_path / kind / name / "checkpoint.safetensors")[0] for name in names)
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one) == same


def test_masks_are_kept_out_of_the_measures(ball_model, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    metrics = trained(ball_model, tmp_path / "out", plan=plan, threads=1, masks=ball_model / "white")
    assert "masks are white" in metrics.protocol
    assert "exposure" in metrics.protocol
    for label, view in metrics.views.items():
        rendered = read_photo(tmp_path / "out" / "renders" / "test" / f"{label}.png").rgb / 255.0
        photo = read_photo(ball_model / "images" / f"{label}.png").rgb / 255.0
        assert view.psnr == pytest.approx(psnr(rendered[:WHITE_ROWS], photo[:WHITE_ROWS]), abs=1e-4)


def test_the_masks_of_a_reconstruction_are_found_by_themselves(ball_model, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    given = trained(ball_model, tmp_path / "a", plan=plan, threads=1, masks=ball_model / "white")
    scene = open_scene(ball_model)
    assert scene.masks_folder is None
    found = train(replace(scene, masks_folder=ball_model / "white"), keep_in=tmp_path / "b", plan=plan, threads=2)
    assert found.metrics is not None
    assert found.metrics.views == given.views
    a, b = ((tmp_path / name / "checkpoint.safetensors").read_bytes() for name in "ab")
    assert a == b


def test_a_stop_does_not_change_a_byte(ball_model, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    trained(ball_model, tmp_path / "a", plan=plan, threads=1)
    trained(ball_model, tmp_path / "b", plan=plan, threads=2, steps=55)
    trained(ball_model, tmp_path / "b", plan=plan, threads=2)
    a, b = ((tmp_path / name / "checkpoint.safetensors").read_bytes() for name in "ab")
    assert a == b


def test_photos_are_reduced_on_request(ball_model, tmp_path):
    plan = write_plan(tmp_path / "plan.json")
    arguments = ["train", str(ball_model), "-o", str(tmp_path / "out"), "--plan", str(plan), "--threads", "1"]
    assert main([*arguments, "--size", "20"]) == 0
    assert "20x16" in json.loads((tmp_path / "out" / "metrics.json").read_text())["protocol"]


@pytest.mark.parametrize("options", [["--size", "0"], ["--field", "tiny", "--size", "20"], ["--masks", "nowhere"]])
def test_mistakes_are_named(ball_model, tmp_path, capsys, options):
    assert main(["train", str(ball_model), "-o", str(tmp_path / "out"), *options]) == 3
    assert options[-2] in capsys.readouterr().err.replace("\n", " ")


def test_masks_of_another_size_are_refused(ball_model, tmp_path):
    for k in range(9):
        write_photo(tmp_path / "masks" / f"r_{k}.png", np.full((8, 8, 3), 255, dtype=np.uint8))
    with pytest.raises(InputError, match="size of its photo"):
        trained(ball_model, tmp_path / "out", threads=1, masks=tmp_path / "masks")
