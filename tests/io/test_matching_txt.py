"""Course folders: written from a scene with known matches, read back; the real one; damage."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.io.given_matches.matching_txt import is_given_matches_folder, read_calibration, read_given_matches
from fieldstone.io.images.photos import write_photo
from fieldstone.synthetic.scenes import SceneOptions, SyntheticScene, synthesize
from mutations import check_mutations
from real_data import data_folder

K_TEXT = "800 0 504.5\n0 810 369.5\n0 0 1"


def make_scene(num_cameras: int = 4) -> SyntheticScene:
    return synthesize(SceneOptions(num_cameras=num_cameras, num_points=40, visibility=0.8), np.random.default_rng(0))


def write_given_matches(folder: Path, scene: SyntheticScene, *, photos: bool = True, newline: str = "\n") -> None:
    """The scene with given matches; every other line of three or more photos is split into lines of two."""
    folder.mkdir(exist_ok=True)
    (folder / "calibration.txt").write_text(K_TEXT)
    truth = scene.truth
    seen = [truth.observations.select(truth.observations.point == p) for p in range(len(truth.points))]
    for i in range(len(truth.views) - 1):
        lines = [f"nFeatures: {len(scene.graph.keypoints[i])}"]
        for p, track in enumerate(seen):
            if i not in track.view:
                continue
            place = dict(zip(track.view.tolist(), track.pixels - 0.5, strict=True))
            head = " ".join(str(x) for x in (*truth.points.rgb[p].tolist(), *place[i].tolist()))
            rest = [f"{j + 1} {float(u)!r} {float(v)!r}" for j, (u, v) in place.items() if j > i]
            groups = [[r] for r in rest] if p % 2 and len(rest) > 1 else [rest]
            lines += [f"{1 + len(group)} {head} {' '.join(group)} " for group in groups if group]
        (folder / f"matching{i + 1}.txt").write_bytes((newline.join(lines) + newline).encode())
    if photos:
        camera = truth.cameras[0]
        for i in range(len(truth.views)):
            (folder / f"{i + 1}.png").write_bytes(black_png(camera.width, camera.height))


@cache
def black_png(width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height)).save(file, "png")
    return file.getvalue()


def matched_places(graph) -> dict:
    """Every match as a pair of places with their colours, whatever the keypoints' order."""
    out = {}
    for (i, j), rows in graph.matches.items():
        out[i, j] = sorted(
            (*graph.keypoints[i][a].round(9), *graph.keypoints[j][b].round(9), *graph.colors[i][a], *graph.colors[j][b])
            for a, b in rows
        )
    return out


@pytest.mark.parametrize("photos", [True, False])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r\n\r\n"])
def test_a_written_scene_is_read_back(tmp_path, photos, newline):
    scene = make_scene()
    write_given_matches(tmp_path, scene, photos=photos, newline=newline)
    given = read_given_matches(tmp_path)
    assert given.graph.names == ("1.png", "2.png", "3.png", "4.png")
    assert matched_places(given.graph) == matched_places(scene.graph)
    assert given.num_repeated == 0
    assert not given.dropped_by_missing_photo
    np.testing.assert_allclose(given.camera.params, scene.truth.cameras[0].params, rtol=1e-12)
    if photos:
        assert (given.camera.width, given.camera.height) == (1000, 750)
        assert given.photos == tuple(tmp_path / f"{k}.png" for k in (1, 2, 3, 4))
    else:
        assert given.photos == (None,) * 4
        beyond = np.concatenate(given.graph.keypoints).max(axis=0)
        assert np.all(beyond <= [given.camera.width, given.camera.height])


def test_a_place_is_one_keypoint_in_however_many_lines(tmp_path):
    (tmp_path / "calibration.txt").write_text(K_TEXT)
    (tmp_path / "matching1.txt").write_text(
        "nFeatures: 9\n2 1 2 3 10 20 2 30 40\n2 1 2 3 10 20 3 50 60\n2 1 2 3 10 20 2 30 40\n1 7 7 7 90 91\n"
    )
    (tmp_path / "matching2.txt").write_text("nFeatures: 9\n2 9 9 9 30 40 3 50 60\n")
    given = read_given_matches(tmp_path)
    graph = given.graph
    np.testing.assert_array_equal(graph.keypoints[0], [[10.5, 20.5], [90.5, 91.5]])
    np.testing.assert_array_equal(graph.keypoints[1], [[30.5, 40.5]])
    np.testing.assert_array_equal(graph.keypoints[2], [[50.5, 60.5]])
    np.testing.assert_array_equal(graph.colors[1], [[9, 9, 9]])  # the photo's own line, not the first that names it
    np.testing.assert_array_equal(graph.colors[2], [[1, 2, 3]])
    assert {pair: rows.tolist() for pair, rows in graph.matches.items()} == {
        (0, 1): [[0, 0]],
        (0, 2): [[0, 0]],
        (1, 2): [[0, 0]],
    }
    assert given.num_given == {(0, 1): 2, (0, 2): 1, (1, 2): 1}
    assert given.num_repeated == 1


@pytest.mark.parametrize(
    "text",
    [
        "531 0 407\n0 532 313\n0 0 1",
        "531 0 407\r\n0 532 313\r\n0 0 1\r\n\r\n",
        "K = [531 0 407; 0 532 313; 0 0 1]",
        "K = [531 0 407;\n     0 532 313;\n     0 0 1];\n",
        "% intrinsics\nK = [531, 0, 407 % row\n0, 532, 313\n0, 0, 1];",
        "K=[5.31e2 0 407;0 532 313.0;0 0 1]",
        "\ufeff531 0 407\n0 532 313\n0 0 1",
    ],
)
def test_dialects_of_the_calibration(tmp_path, text):
    (tmp_path / "calibration.txt").write_bytes(text.encode())
    expected = [[531, 0, 407.5], [0, 532, 313.5], [0, 0, 1]]
    np.testing.assert_array_equal(read_calibration(tmp_path / "calibration.txt"), expected)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 407\n0 532 313\n0 0 1", "line 1: focal length 0 is not positive"),
        ("531 0 407\n0 -532 313\n0 0 1", "line 2: focal length -532"),
        ("531 0 407\n0 532 313\n0 0 2", "line 3: the last row"),
        ("531 0 0\n0 532 0\n407 313 1", "line 3: the last row .* transposed"),
        ("531 0 407\n0 532 313", "has 9 numbers, found 6"),
        ("531 0 407\n0 532 nan\n0 0 1", "line 2: 'nan' is not a finite number"),
        ("531 0 407\n0 x 313\n0 0 1", "line 2: 'x'"),
        ("531 40 407\n0 532 313\n0 0 1", "skew"),
        ("531 0 1e9\n0 532 313\n0 0 1", "principal point"),
        ("", "found 0"),
    ],
)
def test_wrong_calibrations_name_file_and_line(tmp_path, text, message):
    (tmp_path / "calibration.txt").write_text(text)
    with pytest.raises(InputError, match=rf"calibration.txt, .*{message}"):
        read_calibration(tmp_path / "calibration.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line 1: the first line must be"),
        ("3 1 2 3 4 5", "line 1: the first line must be"),
        ("nFeatures: -4\n", "line 1: nFeatures must be a whole number"),
        ("nFeatures: many\n", "line 1: nFeatures must be a whole number"),
        ("nFeatures: 1\n1 0 0 0 1 1\n1 0 0 0 2 2\n", "line 1: nFeatures is 1, but 2 features follow"),
        ("nFeatures: 9\n\n3 0 0 0 1 1 2 3 3\n", "line 3: the number of photos does not fit"),
        ("nFeatures: 9\n2.5 0 0 0 1 1 2 3 3\n", "line 2: the number of photos must"),
        ("nFeatures: 9\n0 0 0 0 1 1\n", "line 2: the number of photos must"),
        ("nFeatures: 9\n2 0 0 0 1\n", "line 2: a feature needs at least 6 numbers"),
        ("nFeatures: 9\n2 0 0 256 1 1 2 3 3\n", "line 2: R G B"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 3 -3\n", "line 2: a coordinate is negative"),
        ("nFeatures: 9\n2 0 0 0 -1 1 2 3 3\n", "line 2: a coordinate is negative"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 3 3\n2 0 0 0 1 nan 2 3 3\n", "line 3: 'nan' is not a finite number"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 3 1_0\n", "line 2: '1_0'"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 1e9 3\n", "line 2: a coordinate is beyond any photo"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 1000.6 3\n", "line 2: a coordinate is outside the photo of 1000 x 750"),
        ("nFeatures: 9\n2 0 0 0 1 1 0 3 3\n", "line 2: photo ids are whole numbers from 1"),
        ("nFeatures: 9\n2 0 0 0 1 1 -2 3 3\n", "line 2: photo ids are whole numbers from 1"),
        ("nFeatures: 9\n2 0 0 0 1 1 1 3 3\n", "line 2: photo 1 is matched with itself"),
        ("nFeatures: 9\n2 0 0 0 1 1 2 3 3\n2 0 0 0 1 1 5 3 3\n", "line 3: photo 5 does not exist: the data set has 4"),
    ],
)
def test_wrong_match_files_name_file_and_line(tmp_path, text, message):
    write_given_matches(tmp_path, make_scene())
    (tmp_path / "matching1.txt").write_text(text)
    with pytest.raises(InputError, match=rf"matching1.txt, {message}"):
        read_given_matches(tmp_path)


def test_matches_with_missing_photos_are_dropped_and_counted(tmp_path, caplog):
    scene = make_scene()
    write_given_matches(tmp_path, scene)
    (tmp_path / "4.png").unlink()
    given = read_given_matches(tmp_path)
    assert given.graph.names == ("1.png", "2.png", "3.png")
    with_last = sum(len(rows) for pair, rows in scene.graph.matches.items() if 3 in pair)
    assert given.dropped_by_missing_photo == {4: with_last}
    assert f"dropped {with_last} of" in caplog.text
    assert matched_places(given.graph) == {p: m for p, m in matched_places(scene.graph).items() if 3 not in p}

    (tmp_path / "2.png").write_bytes((tmp_path / "2.png").read_bytes()[:-30])  # a broken photo counts as missing
    given = read_given_matches(tmp_path)
    assert given.graph.names == ("1.png", "3.png")
    assert [problem.path.name for problem in given.problems] == ["2.png"]
    assert set(given.graph.matches) == {(0, 1)}
    assert matched_places(given.graph)[0, 1] == matched_places(scene.graph)[0, 2]

    (tmp_path / "3.png").unlink()
    with pytest.raises(InputError, match=r"none of its .* matches joins two photos"):
        read_given_matches(tmp_path)


def test_photos_without_numbers_count_in_natural_order(tmp_path):
    write_given_matches(tmp_path, make_scene())
    for i, name in enumerate(["hall_2.png", "hall_3.jpg", "hall_10.png", "hall_11.png"], start=1):
        (tmp_path / f"{i}.png").rename(tmp_path / name)
    assert read_given_matches(tmp_path).graph.names == ("hall_2.png", "hall_3.jpg", "hall_10.png", "hall_11.png")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "calibration.txt").unlink(), "calibration.txt: no such file"),
        (lambda f: [p.unlink() for p in f.glob("matching*.txt")], "no matching"),
        (lambda f: (f / "matching1.txt").rename(f / "matching0.txt"), "ids start at 1"),
        (lambda f: (f / "matching02.txt").write_text("nFeatures: 0"), "both belong to photo 2"),
        (lambda f: (f / "01.png").write_bytes(b""), "are both photo 1"),
        (lambda f: write_photo(f / "3.png", np.zeros((4, 4, 3), dtype=np.uint8)), "all photos need one size"),
        (lambda f: [p.write_bytes(b"") for p in f.glob("*.png")], "none of 4 photos can be read"),
        (lambda f: (f / "matching2.txt").write_bytes(b"\xff\xfe\x00"), "not UTF-8 text"),
    ],
)
def test_folders_that_cannot_be_used_say_why(tmp_path, change, message):
    write_given_matches(tmp_path, make_scene())
    change(tmp_path)
    with pytest.raises(InputError, match=message):
        read_given_matches(tmp_path)


def test_a_file_without_features_is_read(tmp_path):
    scene = make_scene()
    write_given_matches(tmp_path, scene)
    (tmp_path / "matching2.txt").write_text("nFeatures: 0")
    graph = read_given_matches(tmp_path).graph
    assert set(graph.matches) == {pair for pair in scene.graph.matches if pair[0] != 1}


def test_a_data_set_with_given_matches_is_known_by_its_match_files(tmp_path):
    (tmp_path / "calibration.txt").write_text(K_TEXT)
    assert not is_given_matches_folder(tmp_path)
    (tmp_path / "Matching3.TXT").write_text("nFeatures: 0")
    assert is_given_matches_folder(tmp_path)
    assert not is_given_matches_folder(tmp_path / "calibration.txt")


@pytest.mark.parametrize("name", ["matching1.txt", "matching2.txt", "calibration.txt"])
def test_damaged_files_end_in_an_input_error_or_a_sound_graph(tmp_path, name):
    write_given_matches(tmp_path, make_scene(3), photos=False)

    def check(given):
        graph, camera = given.graph, given.camera
        assert camera.focal.min() > 0
        for (i, j), rows in graph.matches.items():
            assert rows[:, 0].max() < len(graph.keypoints[i])
            assert rows[:, 1].max() < len(graph.keypoints[j])
        for keypoints in graph.keypoints:
            assert np.isfinite(keypoints).all()

    loaded, refused = check_mutations(tmp_path / name, lambda: read_given_matches(tmp_path), check, count=300)
    assert min(loaded, refused) > 10


def test_unity_hall_has_its_known_counts():
    given = read_given_matches(data_folder("unity_hall"))
    assert (given.num_given[0, 1], given.num_given[2, 3], given.num_given[0, 4]) == (672, 1183, 206)
    assert given.graph.names == ("1.png", "2.png", "3.png", "4.png", "5.png")
    assert (given.camera.width, given.camera.height) == (800, 600)
    np.testing.assert_allclose(given.camera.params, [531.122155, 531.541738, 407.692551, 313.808715], atol=1e-6)
    assert sum(given.num_given.values()) - given.num_repeated == sum(len(m) for m in given.graph.matches.values())
