"""Files of others are read in one way, and what is wrong with them is said in one way: what, where, what to do."""

import json
import math

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.io.files import others
from fieldstone.io.files.others import camera_pose, finite_number, finite_words, is_finite_word, read_json


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_json_comes_with_or_without_a_byte_order_mark(tmp_path, mark):
    path = tmp_path / "a.json"
    path.write_bytes(mark + '{"ä": [1, NaN]}'.encode())
    value = read_json(path)
    assert list(value) == ["ä"]
    assert math.isnan(value["ä"][1])


def test_comments_are_passed_over_where_they_are_allowed(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{\n// the cube\n"a": "// not a comment"\n}')
    assert read_json(path, comments=True) == {"a": "// not a comment"}
    with pytest.raises(InputError, match="line 2"):
        read_json(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"a": 1,\n "b": }', "line 2: not valid JSON"),
        (b'{"a": "\xff"}', "byte 7: not UTF-8"),
        (b"[" * 100_000, "nested too deeply"),
        (b"[" + b"9" * 5000 + b"]", "number too long"),
        (b"", "line 1: not valid JSON"),
    ],
)
def test_what_is_no_json_is_named_with_its_place(tmp_path, content, message):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as error:
        read_json(path)
    assert str(path) in str(error.value)


def test_no_file_and_a_file_that_is_too_large_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="cannot be read"):
        read_json(tmp_path / "nowhere.json")
    monkeypatch.setattr(others, "MAX_JSON_BYTES", 8)
    (tmp_path / "a.json").write_text(json.dumps(list(range(9))))
    with pytest.raises(InputError, match="right file"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("value", [True, None, "3", math.nan, math.inf, [1], 10**400])
def test_what_is_no_finite_number_is_refused(value):
    with pytest.raises(InputError, match=r"a\.json: frames\[3\]\.fl_x must be a finite number, got"):
        finite_number(value, "a.json: frames[3].fl_x")


@pytest.mark.parametrize("value", [3, -2.5, 0, 1e300])
def test_finite_numbers_come_through(value):
    assert finite_number(value, "") == value


@pytest.mark.parametrize("word", ["1", "-1.5", "+.5e-3", "7.", "1E5"])
def test_words_that_are_numbers(word):
    assert is_finite_word(word)


@pytest.mark.parametrize("word", ["1_000", "nan", "inf", "1e999", "0x1f", "١", "", "1,5", "--1"])
def test_words_that_are_none(tmp_path, word):
    assert not is_finite_word(word)
    with pytest.raises(InputError, match=r"a\.txt, line 7: .* is not a finite number"):
        finite_words(tmp_path / "a.txt", [["1", "2"], ["3", word]], [4, 7])


def test_many_words_are_read_as_python_reads_them(tmp_path):
    rows = np.random.default_rng(0).normal(size=(20, 3))
    words = [[repr(float(x)) for x in row] for row in rows]
    np.testing.assert_array_equal(finite_words(tmp_path, words, range(20)), rows.ravel())


def test_a_pose_may_be_four_rows_or_sixteen_numbers():
    matrix = np.eye(4)
    matrix[:3, 3] = 1, 2, 3
    for value in (matrix.tolist(), matrix.ravel().tolist()):
        pose = camera_pose(value, "a.json: frames[0]")
        np.testing.assert_allclose(pose.target_origin_in_source(), [1, 2, 3])
        np.testing.assert_allclose(pose.R, np.diag([1, -1, -1]))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("x", "no matrix of numbers"),
        ([[1], [2, 3]], "no matrix of numbers"),
        (np.eye(3).tolist(), "must be 4x4"),
        (np.diag([1.0, 1, -1, 1]).tolist(), "it mirrors"),
        (np.diag([2.0, 1, 1, 1]).tolist(), "not orthonormal"),
        (np.full((4, 4), math.nan).tolist(), "not finite"),
    ],
)
def test_what_is_no_pose_is_named(value, message):
    with pytest.raises(InputError, match=rf"frames\[2\]\.transform_matrix is no .*{message}|{message}"):
        camera_pose(value, "a.json: frames[2].transform_matrix")
