"""A trained ball to a mesh and to splats, as typed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.io.images.photos import write_photo
from fieldstone.io.shapes.ply import read_points
from fieldstone.run.field import open_field
from fieldstone.run.options import SurfaceOptions
from grid_scenes import RADIUS, ball_photos, psnr_of_one_color
from training import trained


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A field of the ball, from a transforms.json."""
    folder = tmp_path_factory.mktemp("ball")
    photos = ball_photos(24, heights=(0.3, 2.4, -2.2))
    frames = []
    for v, name in enumerate(photos.posed.names):
        write_photo(folder / f"{name}.png", photos.pixels[v])
        matrix = photos.posed.pose_of(v).inverse().matrix() @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": photos.posed.camera_of(0).focal[0], "frames": frames}))
    plan = {"finest": 48, "steps": [40] * 8, "num_chunks": 2, "samples_per_chunk": 1024}
    (folder / "plan.json").write_text(json.dumps(plan))
    trained(folder, folder / "out", plan=folder / "plan.json", threads=2)
    return folder / "out"


def test_the_mesh_of_a_ball(ball, tmp_path):
    found = open_field(ball).mesh(threads=1)
    found.save(tmp_path / "ball.ply")
    found.save(tmp_path / "ball.obj")
    assert (tmp_path / "ball.obj").stat().st_size > 1000
    record = found.record("ball.ply")
    points = read_points(tmp_path / "ball.ply")
    assert len(points.xyz) == record.vertices
    distance = np.linalg.norm(points.xyz, axis=1)
    # Pixels are 0.07 wide at the ball; a surface learned from them is right to a fraction of one.
    assert np.median(np.abs(distance - RADIUS)) < 0.03
    # Colours are those of the normal.
    seen = np.abs(distance - RADIUS) < 0.05
    expected = 255 * (0.5 + 0.5 * points.xyz[seen] / distance[seen, None])
    assert np.median(np.abs(points.rgb[seen] - expected)) < 20
    assert record.closed
    assert record.silhouette_iou > 0.93
    assert record.depth_error_median_percent is not None
    assert record.depth_error_median_percent < 2.0


def test_mesh_and_splats_as_typed(ball, capsys):
    assert main(["mesh", str(ball), "--format", "glb", "--cells", "32", "--threads", "1"]) == 0
    assert (ball / "mesh.glb").stat().st_size > 1000
    assert "IoU" in capsys.readouterr().out
    assert main(["splat", str(ball), "--threads", "1"]) == 0
    record = json.loads((ball / "splats.json").read_text())
    assert json.loads((ball / "mesh.json").read_text())["path"] == "mesh.glb"
    assert "PSNR" in capsys.readouterr().out
    points = read_points(ball / record["path"])
    assert len(points.xyz) == record["splats"]
    # Splats lie an edge below the surface, and cells are 0.07 wide.
    assert np.median(np.abs(np.linalg.norm(points.xyz, axis=1) - RADIUS)) < 0.12
    # Pixels are as large as splats here: half the error of the best single colour.
    photos = ball_photos(24, heights=(0.3, 2.4, -2.2))
    best_single_color = np.mean([psnr_of_one_color(photos, v) for v in range(len(photos))])
    assert record["psnr_to_field"] > best_single_color + 20 * np.log10(2)
    # Without its colours the ball is met to 17 dB, and a ball of one flat colour comes close to the bound above.
    assert record["psnr_to_field"] > 22


@pytest.mark.parametrize(("options", "message"), [({"level": 1.0}, "`level`"), ({"cells": 1}, "`cells`")])
def test_mistakes_are_named(options, message):
    with pytest.raises(InputError, match=message):
        SurfaceOptions(**options)


def test_only_the_grid_field_has_a_surface(ball):
    field = open_field(ball)
    network = replace(field, header=replace(field.header, field="nerf"))
    for make in (network.mesh, network.splats):
        with pytest.raises(InputError, match="needs the fast field, not the nerf network"):
            make()
