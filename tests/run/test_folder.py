"""One folder knows every file of a run, lets one process write, and reads back what was written."""

import json

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.records.field import CurvePoint, FieldHeader, FieldMetrics, FrameRecord, ViewScores
from fieldstone.records.mapping import CameraRecord
from fieldstone.run.folder import RunFolder

HEADER = FieldHeader(
    field="fast",
    options={"use_alpha": True},
    seed=3,
    photos="0" * 64,
    frame=FrameRecord(0.5, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.1, 0.2, 0.3), 2.0, 6.0, (1.0,) * 3),
    names=("a", "b"),
    cameras=(CameraRecord("SIMPLE_PINHOLE", 20, 16, (24.0, 10.0, 8.0)),),
    camera_of_view=(0, 0),
)
METRICS = FieldMetrics(
    psnr=20.125,
    ssim=0.1 + 0.2,
    views={"a": ViewScores(20.125, 0.1 + 0.2)},
    protocol="as is",
    seconds=1.5,
    steps=7,
    field="fast",
    device="cpu",
    threads=1,
    seed=3,
    version="0",
    plan={"steps": [1, 2]},
)


def test_records_come_back_as_they_were(tmp_path):
    out = RunFolder(tmp_path)
    curve = (CurvePoint(1, 0.1, -2.5, 12.0), CurvePoint(2, 0.2, -2.75, 12.5))
    tensors = {"state.step": np.array(2), "views.t": np.arange(6.0).reshape(2, 3)}
    out.write_metrics(METRICS)
    out.write_curve(curve)
    out.write_checkpoint(HEADER, tensors)
    assert out.read_metrics() == METRICS
    assert out.read_curve() == curve
    header, found = out.read_checkpoint()
    assert header == HEADER
    assert not header.differences(HEADER)
    np.testing.assert_array_equal(found["views.t"], tensors["views.t"])


def test_nothing_is_there_before_it_was_written(tmp_path):
    out = RunFolder(tmp_path)
    assert out.read_run() is None
    assert out.read_metrics() is None
    assert out.read_curve() == ()
    with pytest.raises(InputError, match="no such folder"):
        RunFolder(tmp_path / "nowhere").read_story()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "cannot be read"),
        ("[]", "not what this version writes"),
        (json.dumps({"psnr": "high"}), r"psnr"),
        (json.dumps({"psnr": 1.0}), "missing required field"),
    ],
)
def test_a_damaged_record_is_named_with_what_is_wrong(tmp_path, content, message):
    out = RunFolder(tmp_path)
    out.metrics.write_text(content)
    with pytest.raises(InputError, match=message) as error:
        out.read_metrics()
    assert str(out.metrics) in str(error.value)


def test_differences_of_headers_are_named():
    from dataclasses import replace

    assert HEADER.differences(replace(HEADER, seed=4, photos="1" * 64)) == ["seed", "photos"]


@pytest.fixture
def held_folder(tmp_path):
    """A folder with a field that another process seems to write to."""
    photo = {"transform_matrix": np.eye(4).tolist(), "file_path": "a.png"}
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 20.0, "w": 20, "h": 16, "frames": [photo]}))
    out = RunFolder(tmp_path / "out")
    out.write_checkpoint(HEADER, {"views.R": np.stack([np.eye(3)] * 2), "views.t": np.zeros((2, 3))})
    with out.sole_writer():
        yield out


@pytest.mark.parametrize("verb", ["reconstruct", "train", "render", "mesh", "splat", "report", "demo"])
def test_every_verb_that_writes_waits_for_no_one(held_folder, capsys, verb):
    """Two writers in one folder would interleave their files."""
    out, source = str(held_folder.path), str(held_folder.path.parent)
    arguments = {"reconstruct": [source, "-o", out], "train": [source, "-o", out], "demo": ["-o", out]}.get(verb, [out])
    before = {path: path.read_bytes() for path in held_folder.path.rglob("*") if path.is_file()}
    assert main([verb, *arguments]) == 3
    error = capsys.readouterr().err
    assert "is writing there" in error
    assert error.count("\n") == 1
    assert {path: path.read_bytes() for path in held_folder.path.rglob("*") if path.is_file()} == before
