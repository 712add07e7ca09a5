"""Bad photos among good ones, and what is said of them."""

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.features.sift import SiftOptions
from fieldstone.io.files.cache import UnitCache
from fieldstone.io.models.colmap import read_colmap
from fieldstone.progress import Progress
from fieldstone.run.matching.detection import sharpness
from fieldstone.run.matching.options import MatchingOptions
from fieldstone.run.matching.photos_to_graph import match_photos
from fieldstone.run.reconstruct import reconstruct
from fieldstone.run.reconstruct_options import ReconstructOptions, Tuning
from fieldstone.synthetic import materials
from fieldstone.synthetic.construction import Builder
from fieldstone.synthetic.light import Sky, level_camera
from fieldstone.synthetic.patches import Texture
from fieldstone.synthetic.photos import House, PhotoOptions, photograph

OPTIONS = MatchingOptions(sift=SiftOptions(max_features=1000), threads=2)

TEXELS = (np.arange(0.015, 16.0, 0.03, dtype=np.float32), np.arange(0.015, 12.0, 0.03, dtype=np.float32))
HOUSE = PhotoOptions(width=320, height=240, samples_per_axis=1)


@pytest.fixture
def photos(house_photos, tmp_path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(house_photos, tmp_path / "photos"))


def matched(photos: Path, options: MatchingOptions = OPTIONS):
    return match_photos(photos, options, 0, UnitCache())


def test_progress_counts_photos_and_pairs_also_of_an_earlier_run(photos, tmp_path):
    cache = UnitCache(tmp_path / "units")
    for _ in range(2):
        events: list[Progress] = []
        found = match_photos(photos, OPTIONS, 0, cache, events.append)
        assert list(dict.fromkeys(e.stage for e in events)) == ["finding features", "matching", "verifying pairs"]
        num_files = len(found.graph.names) + len(found.problems)
        for stage, total in (("finding features", num_files), ("verifying pairs", len(found.graph.matches))):
            done = [e.done for e in events if e.stage == stage]
            assert (done[0], done[-1]) == (0, total)
            assert done == sorted(done)


def test_no_features_under_masks(photos, tmp_path):
    (tmp_path / "masks").mkdir()
    keep = np.zeros((240, 320), dtype=np.uint8)
    keep[:, :200] = 255
    for path in photos.iterdir():
        Image.fromarray(keep).save(tmp_path / "masks" / f"{path.name}.png")
    options = replace(OPTIONS, masks=tmp_path / "masks")
    graph = matched(photos, options).graph
    assert max(k[:, 0].max() for k in graph.keypoints) < 200.0
    cache = UnitCache(tmp_path / "units")
    for _ in range(2):
        again = match_photos(photos, options, 0, cache).graph
        np.testing.assert_array_equal(again.keypoints[3], graph.keypoints[3])
    Image.fromarray(255 - keep).save(tmp_path / "masks" / "house_03.jpg.png")
    changed = match_photos(photos, options, 0, cache).graph
    assert changed.keypoints[3][:, 0].min() >= 200.0
    np.testing.assert_array_equal(changed.keypoints[2], graph.keypoints[2])


def test_copies_are_used_once(photos):
    shutil.copy(photos / "house_02.jpg", photos / "zz.jpg")
    material = matched(photos)
    assert len(material.graph.names) == 6
    (problem,) = material.problems
    assert (problem.path.name, problem.kind) == ("zz.jpg", "not used")
    assert problem.reason == "duplicate of house_02.jpg, byte for byte"


def test_one_photo_many_times_is_one_clear_error(photos):
    for path in sorted(photos.iterdir())[1:]:
        shutil.copy(photos / "house_00.jpg", path)
    with pytest.raises(
        InputError, match=r"two different readable photos, found 1; house_01.jpg: duplicate of house_00"
    ):
        matched(photos)


def test_odd_names(photos):
    names = ["a b.jpg", "häuschen ü.jpg", "new\nline.jpg", "a..b.jpg", "<script>.jpg"]
    for path, name in zip(sorted(photos.iterdir()), names, strict=False):
        path.rename(photos / name)
    shutil.copy(photos / "a b.jpg", os.fsencode(photos / "x.jpg").replace(b"x.jpg", b"\xff.jpg"))
    material = matched(photos)
    assert set(material.graph.names) == {"a b.jpg", "häuschen ü.jpg", "a..b.jpg", "<script>.jpg", "house_05.jpg"}
    assert sorted(p.path.name for p in material.problems) == ["new\nline.jpg", "\udcff.jpg"]
    assert all("rename it" in p.reason for p in material.problems)


def test_bad_files_take_no_good_photo_away(photos, tmp_path):
    expected = matched(photos).graph
    data = (photos / "house_01.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(data[: len(data) // 2])
    (photos / "empty.jpg").write_bytes(b"")
    (photos / "text.jpg").write_text("hello")
    Image.new("RGB", (1, 1)).save(photos / "tiny.png")
    Image.new("RGB", (30_000, 20), (90, 120, 40)).save(photos / "wide.jpg")
    material = matched(photos)
    assert sorted(p.path.name for p in material.problems) == ["cut.jpg", "empty.jpg", "text.jpg"]
    graph = material.graph
    good = [graph.names.index(name) for name in expected.names]
    for (i, j), two_view in expected.two_views.items():
        again = graph.two_views[good[i], good[j]]
        assert again.kind == two_view.kind
        assert abs(int(again.inliers.sum()) - int(two_view.inliers.sum())) <= 0.1 * len(two_view.inliers)


def test_sharpness_falls_with_blur(photos):
    grey = np.asarray(Image.open(photos / "house_03.jpg").convert("L"))
    values = [sharpness(np.asarray(cv2.GaussianBlur(grey, (0, 0), s), dtype=np.uint8)) for s in (0.5, 1.0, 2.0, 4.0)]
    assert sharpness(grey) > values[0]
    assert values == sorted(values, reverse=True)
    assert sharpness(np.full_like(grey, 7)) == 0.0


def test_every_photo_left_out_gets_a_verdict_with_a_number(photos):
    rgb = np.asarray(Image.open(photos / "house_03.jpg"))
    Image.fromarray(np.asarray(cv2.GaussianBlur(rgb, (0, 0), 8.0), dtype=np.uint8)).save(photos / "house_03.jpg")
    Image.fromarray(np.full((240, 320, 3), 90, dtype=np.uint8)).save(photos / "wall.png")
    shutil.copy(photos / "house_01.jpg", photos / "copy.jpg")
    options = ReconstructOptions(tuning=Tuning(sift=OPTIONS.sift), threads=2)
    record = reconstruct(photos, options).record
    assert record is not None
    verdicts = {photo.name: photo.verdict for photo in record.photos if not photo.registered}
    assert set(verdicts) == {"house_03.jpg", "wall.png", "house_01.jpg"}
    assert re.search(r"\d+ features; \d+ % as sharp as the median photo", verdicts["house_03.jpg"])
    assert "0 features" in verdicts["wall.png"]
    assert verdicts["house_01.jpg"] == "not used: duplicate of copy.jpg, byte for byte"


@pytest.mark.parametrize("factor", [0.25, 0.56, 1.25, 1.8, 10.0])
def test_a_wrong_focal_length_in_exif_is_noticed(photos, factor, caplog):
    """The cameras were given 29 mm; the vote is good to a few percent on photos of this size."""
    truth = 29 / np.hypot(36.0, 24.0) * np.hypot(320, 240)
    rewrite_focal(photos, 29 * factor)
    material = matched(photos)
    (note,) = material.notes
    assert "EXIF is not used" in note
    assert note in caplog.text
    assert material.cameras[0].params[0] == pytest.approx(truth, rel=0.05)


@pytest.mark.parametrize("factor", [0.97, 1.0, 1.03])
def test_exif_that_is_a_little_off_is_believed(photos, factor):
    """And drawn a little towards what the photos say, which is closer to the truth or as close."""
    rewrite_focal(photos, 29 * factor)
    material = matched(photos)
    assert not material.notes
    truth = 29 / np.hypot(36.0, 24.0) * np.hypot(320, 240)
    assert material.cameras[0].params[0] == pytest.approx(truth, rel=0.04)


def verdicts_of(folder: Path, tmp_path: Path, code: int) -> tuple[dict, dict[str, str]]:
    """The run of the real command on a folder, and its verdicts by photo."""
    assert main(["reconstruct", str(folder), "-o", str(tmp_path / "out"), "--threads", "2"]) == code
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    return record, {photo["name"]: photo["verdict"] for photo in record["photos"]}


def test_photos_of_two_folders_with_the_same_names_are_one_model(photos, tmp_path):
    both = tmp_path / "both"
    for k, path in enumerate(sorted(photos.iterdir())):
        side = both / ("left" if k % 2 == 0 else "right")
        side.mkdir(parents=True, exist_ok=True)
        path.rename(side / f"{k // 2}.jpg")
    (both / "right" / "3.jpg").write_bytes(b"no photo")
    record, verdicts = verdicts_of(both, tmp_path, 0)
    assert record["components"] == [6]
    assert list(verdicts) == [f"{side}/{k}.jpg" for side in ("left", "right") for k in range(3)] + ["right/3.jpg"]
    views = read_colmap(tmp_path / "out" / "sparse" / "0").views
    assert sorted(view.name for view in views) == sorted(verdicts)[:-1]
    assert (tmp_path / "out" / "report.html").is_file()
    model = reconstruct(both, cameras="per-folder", threads=2).model
    assert model is not None
    assert len(model.cameras) == 2


def test_the_same_photo_saved_anew_is_no_model_and_no_focal_length(photos, tmp_path):
    with Image.open(photos / "house_00.jpg") as image:
        for k, path in enumerate(sorted(photos.iterdir())[1:4]):
            image.save(path, exif=image.getexif(), quality=90 - k)
    for name in ("house_04.jpg", "house_05.jpg"):
        (photos / name).unlink()
    record, verdicts = verdicts_of(photos, tmp_path, 4)
    assert record["components"] == [0]
    assert not any("focal" in note for note in record["notes"])
    assert all("no depth" in verdict for verdict in verdicts.values())
    assert not (tmp_path / "out" / "sparse").exists()


def test_photos_without_texture_are_told_so(tmp_path):
    (tmp_path / "grey").mkdir()
    for k in range(3):
        noise = np.random.default_rng(k).normal(120 + k, 1.0, size=(120, 160, 3))
        Image.fromarray(noise.astype(np.uint8)).save(tmp_path / "grey" / f"{k}.jpg")
    _, verdicts = verdicts_of(tmp_path / "grey", tmp_path, 4)
    assert all("of its 0 features" in verdict for verdict in verdicts.values())


@pytest.fixture(scope="module")
def other_photos(tmp_path_factory) -> Path:
    """Photos of a bare stone wall: one plane, and another place than the house."""
    folder = tmp_path_factory.mktemp("wall")
    wall = a_wall()
    poses = [
        level_camera(
            np.array([1.2 * (k - 2.5), -9.0 + 0.5 * (k % 2), 3.0 + 0.4 * (k % 3)]), np.array([0.2 * k - 0.5, 0, 3])
        )
        for k in range(5)
    ]
    shoot(wall, poses, folder, "wall")
    return folder


def a_wall() -> House:
    build = Builder()
    build.quad((-8, 0, -2), (1, 0, 0), (0, 0, 1), 16.0, 12.0, materials.fieldstone)
    texture = Texture.build(materials.fieldstone(*np.meshgrid(*TEXELS), np.random.default_rng(0)), 0.03)
    return House(
        (build.surfaces[0].patch,), (texture,), np.ones((1, 3), np.float32), Sky.draw(np.random.default_rng(1))
    )


def shoot(house: House, poses, folder: Path, name: str) -> None:
    """Photos with the EXIF focal length of their camera."""
    for k, pose in enumerate(poses):
        pixels = photograph(house, HOUSE.camera(), pose, HOUSE, np.random.default_rng(k))
        exif = Image.Exif()
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = HOUSE.focal_35mm
        Image.fromarray(pixels).save(folder / f"{name}_{k}.jpg", quality=95, exif=exif)


def test_one_plane_is_reconstructed(other_photos, tmp_path):
    record, _ = verdicts_of(other_photos, tmp_path, 0)
    assert record["components"] == [5]
    xyz = read_colmap(tmp_path / "out" / "sparse" / "0").points.xyz
    spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    assert spread[2] < 0.05 * spread[1]


def test_two_scenes_in_one_folder_are_two_models(photos, other_photos, tmp_path):
    for path in other_photos.iterdir():
        shutil.copy(path, photos)
    record, verdicts = verdicts_of(photos, tmp_path, 0)
    assert sorted(record["components"]) == [5, 6]
    of_model = [{v.name[:5] for v in read_colmap(tmp_path / "out" / "sparse" / str(k)).views} for k in range(2)]
    assert sorted(of_model, key=min) == [{"house"}, {"wall_"}]
    assert all(v.startswith(("registered", "in a model of its own (2 of 2)")) for v in verdicts.values())


def test_photos_of_different_places_are_no_model(house_photos, other_photos, tmp_path):
    (tmp_path / "strangers").mkdir()
    shutil.copy(house_photos / "house_00.jpg", tmp_path / "strangers")
    shutil.copy(other_photos / "wall_0.jpg", tmp_path / "strangers")
    _, verdicts = verdicts_of(tmp_path / "strangers", tmp_path, 4)
    assert all("shares enough of its" in verdict for verdict in verdicts.values())


def test_a_camera_that_only_turns_is_told_so(tmp_path):
    (tmp_path / "turn").mkdir()
    poses = [
        level_camera(np.array([0.0, -9.0, 3.0]), np.array([1.3 * k - 2.0, 0.0, 3.0 + 0.3 * (k % 2)])) for k in range(4)
    ]
    shoot(a_wall(), poses, tmp_path / "turn", "turn")
    _, verdicts = verdicts_of(tmp_path / "turn", tmp_path, 4)
    assert all("only turned" in verdict for verdict in verdicts.values())


def rewrite_focal(photos: Path, focal_35mm: float) -> None:
    """Write the photos anew with another focal length in EXIF."""
    for path in photos.iterdir():
        with Image.open(path) as image:
            exif = image.getexif()
            exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = round(focal_35mm)
            image.load()
            image.save(path, exif=exif, quality=95)


def with_exif(source: Path, target: Path, focal_35mm: int | None) -> None:
    """The same pixels, with another focal length in EXIF."""
    exif = Image.Exif()
    if focal_35mm is not None:
        exif[Base.Model] = "a camera"
        exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = focal_35mm
    with Image.open(source) as image:
        Image.fromarray(np.asarray(image)).save(target, exif=exif)


def test_of_copies_with_other_exif_the_one_stays_that_says_what_most_photos_say(photos):
    originals = sorted(photos.glob("*.jpg"))
    for path in originals:
        with_exif(path, path.with_suffix(".png"), 29)
    for k, focal in enumerate((20, 29, 50, 80)):
        with_exif(originals[2], photos / f"a_copy_{k}.png", focal)
    for path in originals:
        path.unlink()
    found = matched(photos)
    assert found.graph.names == (
        "a_copy_1.png",
        *(p.with_suffix(".png").name for k, p in enumerate(originals) if k != 2),
    )
    assert {problem.path.name for problem in found.problems} == {
        "a_copy_0.png", "a_copy_2.png", "a_copy_3.png", originals[2].with_suffix(".png").name,
    }  # fmt: skip
    assert all(problem.reason.startswith("duplicate of a_copy_1.png") for problem in found.problems)
    assert len(found.cameras) == 1


def test_copies_of_which_no_exif_is_that_of_another_photo_have_none(photos):
    originals = sorted(photos.glob("*.jpg"))
    for path in originals:
        with_exif(path, path.with_suffix(".png"), None)
    for k, focal in enumerate((20, 50)):
        with_exif(originals[2], photos / f"a_copy_{k}.png", focal)
    for path in (*originals, originals[2].with_suffix(".png")):
        path.unlink()
    found = matched(photos)
    assert "a_copy_0.png" in found.graph.names
    assert len(found.cameras) == 1


def as_panorama(path: Path) -> None:
    xmp = b'<rdf:Description xmlns:GPano="x" GPano:ProjectionType="equirectangular"/>'
    with Image.open(path) as image:
        pixels = np.asarray(image)
    Image.fromarray(pixels).save(path, xmp=xmp)


def test_a_panorama_among_photos_is_skipped_and_many_are_refused(photos):
    paths = sorted(photos.glob("*.jpg"))
    as_panorama(paths[0])
    found = matched(photos)
    assert paths[0].name not in found.graph.names
    assert [p.path.name for p in found.problems] == [paths[0].name]
    assert "panorama" in found.problems[0].reason
    for path in paths[1:4]:
        as_panorama(path)
    with pytest.raises(InputError, match="4 of 6 photos are panoramas"):
        matched(photos)


def test_alpha_is_a_mask(photos):
    for path in sorted(photos.glob("*.jpg")):
        with Image.open(path) as image:
            pixels = np.asarray(image)
        alpha = np.zeros(pixels.shape[:2], dtype=np.uint8)
        alpha[:, : pixels.shape[1] // 2] = 255
        Image.fromarray(np.dstack([pixels, alpha])).save(path.with_suffix(".png"))
        path.unlink()
    for photo in matched(photos).photos:
        assert len(photo.features) > 50
        assert photo.features.keypoints[:, 0].max() < photo.info.width // 2 - 1
