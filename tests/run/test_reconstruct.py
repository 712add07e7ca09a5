"""From folders to models through the command line, on given matches and on photos."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.evaluate.reconstruction_metrics import pairwise_pose_errors_deg
from fieldstone.geometry.camera import Camera
from fieldstone.io.given_matches.matching_txt import read_given_matches
from fieldstone.io.models.colmap import read_colmap
from fieldstone.scene.match_graph import MatchGraph
from fieldstone.scene.reconstruction import Reconstruction, View
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from fieldstone.synthetic.symmetric import SymmetricOptions, synthesize_symmetric
from matchers import assert_reconstruction_near
from real_data import data_folder


def write_given_matches(folder: Path, *, matlab: bool = False, seed: int = 0) -> Reconstruction:
    """A synthetic scene with given matches, without photos; returns the truth."""
    options = SceneOptions(num_cameras=4, num_points=150, layout="arc", noise_px=0.3, outlier_share=0.1)
    scene = synthesize(options, np.random.default_rng(seed))
    write_matching_txt(scene.graph, scene.truth.cameras[0], folder, matlab=matlab)
    return scene.truth


def write_matching_txt(graph: MatchGraph, camera: Camera, folder: Path, *, matlab: bool = False) -> None:
    """Matches as `matching*.txt`; photo k of the graph is photo k + 1 of the folder."""
    K = camera.calibration_matrix()
    K[:2, 2] -= 0.5
    rows = [" ".join(repr(float(x)) for x in row) for row in K]
    folder.mkdir(parents=True)
    text = f"K = [{'; '.join(rows)}];" if matlab else "\n".join(rows)
    (folder / "calibration.txt").write_text(text + "\n")
    for i in range(graph.num_images - 1):
        lines = []
        for (a, b), matches in sorted(graph.matches.items()):
            if a == i:
                for k, m in matches.tolist():
                    u, v = graph.keypoints[a][k] - 0.5
                    x, y = graph.keypoints[b][m] - 0.5
                    place = " ".join(repr(float(c)) for c in (u, v))
                    other = " ".join(repr(float(c)) for c in (x, y))
                    lines.append(f"2 10 20 30 {place} {b + 1} {other} ")
        end = "\r\n" if matlab else "\n"
        (folder / f"matching{i + 1}.txt").write_bytes(end.join([f"nFeatures: {len(lines)}", *lines, ""]).encode())


@pytest.mark.slow
@pytest.mark.parametrize("max_view_change_deg", [40.0, 180.0])
def test_given_matches_of_a_symmetric_building_are_not_folded(tmp_path, max_view_change_deg):
    options = SymmetricOptions(points_per_side=200, max_view_change_deg=max_view_change_deg)
    scene = synthesize_symmetric(options, np.random.default_rng(0))
    write_matching_txt(scene.graph, scene.truth.cameras[0], tmp_path / "scene")
    assert main(["reconstruct", str(tmp_path / "scene"), "-o", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert any("ambiguous scene" in note for note in record["notes"])
    assert sum(record["components"]) >= 26
    for k in range(len(record["components"])):
        model = read_colmap(tmp_path / "out" / "sparse" / str(k))
        views = tuple(View(f"photo_{int(Path(v.name).stem) - 1:04d}.png", 0, v.cam_from_world) for v in model.views)
        errors = pairwise_pose_errors_deg(replace(model, views=views), scene.truth)
        assert errors[np.isfinite(errors)].max() < 1.0


@pytest.mark.parametrize("matlab", [False, True], ids=["plain, LF", "MATLAB, CRLF"])
def test_given_matches_give_model_table_and_report(tmp_path, matlab, caplog):
    truth = write_given_matches(tmp_path / "scene", matlab=matlab)
    out = tmp_path / "out"
    assert main(["reconstruct", str(tmp_path / "scene"), "-o", str(out)]) == 0
    assert not caplog.records  # matches may come without photos
    record = json.loads((out / "run.json").read_text())
    assert record["summary"]["registered"] == 4
    assert {row["stage"] for row in record["table"]} >= {"linear triangulation", "PnP RANSAC", "after BA"}
    assert record["summary"]["rms_px"] < 0.3 * np.sqrt(2) * 1.1
    model = read_colmap(out / "sparse" / "0")
    by_number = {f"{int(Path(v.name).stem.split('_')[-1])}": v for v in model.views}
    assert len(by_number) == 4
    renamed = [v.name for v in sorted(model.views, key=lambda v: v.name)]
    names = dict(zip(renamed, [v.name for v in truth.views], strict=True))
    views = tuple(type(v)(names[v.name], v.camera, v.cam_from_world) for v in model.views)
    assert_reconstruction_near(
        Reconstruction(model.cameras, views, model.points, model.observations),
        truth,
        angle_deg=0.2,
        relative_distance=0.01,
    )
    assert (out / "points.ply").stat().st_size > 1000
    assert "Content-Security-Policy" in (out / "report.html").read_text()
    assert not list(out.rglob(".writing-*"))


def peer_model(folder: Path, out: Path):
    """pycolmap's incremental mapper on the same matches, with the same fixed camera."""
    pycolmap = pytest.importorskip("pycolmap")
    given = read_given_matches(folder)
    graph, camera, database = given.graph, given.camera, out / "database.db"
    reader, options = pycolmap.ImageReaderOptions(), pycolmap.IncrementalPipelineOptions()
    reader.camera_model, reader.camera_params = camera.model, ",".join(map(str, camera.params))
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.num_threads = 1
    (out / "photos").mkdir(parents=True)
    for name in graph.names:
        (out / "photos" / name).symlink_to(folder / name)
    pycolmap.Database.open(database).close()
    pycolmap.import_images(database, out / "photos", camera_mode=pycolmap.CameraMode.SINGLE, options=reader)
    with pycolmap.Database.open(database) as tables:
        ids = {image.name: image.image_id for image in tables.read_all_images()}
        for name, keypoints in zip(graph.names, graph.keypoints, strict=True):
            tables.write_keypoints(ids[name], keypoints.astype(np.float32))
        for (i, j), rows in graph.matches.items():
            tables.write_matches(ids[graph.names[i]], ids[graph.names[j]], rows.astype(np.uint32))
    (out / "pairs.txt").write_text("".join(f"{graph.names[i]} {graph.names[j]}\n" for i, j in graph.matches))
    pycolmap.verify_matches(database, out / "pairs.txt")
    models = pycolmap.incremental_mapping(database, out / "photos", out / "sparse", options)
    return max(models.values(), key=lambda model: model.num_reg_images())


def test_hall_beats_the_peer_and_the_peer_agrees_on_the_error(tmp_path):
    """More points and observations than pycolmap from the same matches and camera, and smaller residuals."""
    pycolmap = pytest.importorskip("pycolmap")
    folder = data_folder("unity_hall")
    assert main(["reconstruct", str(folder), "-o", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "run.json").read_text())["summary"]
    assert summary["registered"] == summary["photos"] == 5
    peer = peer_model(folder, tmp_path / "peer")
    assert summary["registered"] >= peer.num_reg_images()
    assert summary["points"] > peer.num_points3D()
    assert summary["observations"] > peer.compute_num_observations()
    assert summary["mean_px"] < peer.compute_mean_reprojection_error()
    other = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    errors = [
        np.linalg.norm(image.project_point(other.points3D[p.point3D_id].xyz) - p.xy)
        for image in other.images.values()
        for p in image.points2D
        if p.has_point3D()
    ]
    assert len(errors) == summary["observations"]
    assert abs(np.mean(errors) - summary["mean_px"]) < 1e-3


@pytest.fixture
def folder(tmp_path) -> Path:
    write_given_matches(tmp_path / "scene")
    return tmp_path / "scene"


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def broken(folder: Path, case: str) -> None:
    matching = folder / "matching1.txt"
    first = matching.read_text().splitlines()[1].split()
    match case:
        case "count":
            edit(matching, "2 10 20 30", "7 10 20 30")
        case "negative":
            edit(matching, first[4], "-5.5")
        case "nan":
            edit(matching, first[4], "nan")
        case "zero id":
            edit(matching, " ".join(first), " ".join([*first[:6], "0", *first[7:]]))
        case "zero focal":
            (folder / "calibration.txt").write_text("0 0 500\n0 800 300\n0 0 1\n")
        case "empty":
            shutil.rmtree(folder)
            folder.mkdir()


@pytest.mark.parametrize("case", ["count", "negative", "nan", "zero id", "zero focal", "empty"])
def test_bad_input_is_one_line_and_nothing_is_written(folder, tmp_path, capsys, case):
    broken(folder, case)
    out = tmp_path / "out"
    assert main(["reconstruct", str(folder), "-o", str(out)]) == 3
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.startswith("fieldstone: ")
    assert "Traceback" not in message
    assert str(folder) in message
    if case in ("count", "negative", "nan", "zero id"):
        assert "matching1.txt" in message
        assert "line 2" in message or ":2" in message
    assert not out.exists() or not any(out.iterdir())


def test_one_photo_or_none_is_refused(tmp_path, capsys):
    from PIL import Image

    folder = tmp_path / "photos"
    folder.mkdir()
    Image.new("RGB", (64, 48)).save(folder / "a.png")
    (folder / "b.jpg").write_bytes(b"not a photo")
    assert main(["reconstruct", str(folder), "-o", str(tmp_path / "out")]) == 3
    message = capsys.readouterr().err
    assert "at least two" in message
    assert "b.jpg" in message
    assert main(["reconstruct", str(tmp_path / "nowhere"), "-o", str(tmp_path / "out")]) == 3
