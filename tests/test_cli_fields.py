"""`fieldstone train` and `fieldstone render` as they are typed."""

import json

import numpy as np
import pytest

from fieldstone.cli import main
from fieldstone.errors import InputError
from fieldstone.io.images.photos import write_photo
from fieldstone.run.options import seconds


@pytest.fixture
def blender_folder(tmp_path):
    """Two photos of nothing much, far too few for a good field."""
    matrix = [[1, 0, 0, 0], [0, 0, -1, -4], [0, 1, 0, 0], [0, 0, 0, 1]]
    pixels = np.zeros((12, 16, 4), dtype=np.uint8)
    pixels[3:9, 4:10] = [200, 80, 20, 255]
    for split in ("train", "test"):
        write_photo(tmp_path / "in" / split / "r_0.png", pixels)
        frames = [{"file_path": f"./{split}/r_0", "transform_matrix": matrix}]
        text = json.dumps({"camera_angle_x": 0.9, "frames": frames})
        (tmp_path / "in" / f"transforms_{split}.json").write_text(text)
    return tmp_path / "in"


def test_train_then_render(blender_folder, tmp_path, capsys):
    pytest.importorskip("torch")
    out = tmp_path / "out"
    steps = ["--field", "tiny", "--steps", "2", "--threads", "1"]
    assert main(["train", str(blender_folder), "-o", str(out), *steps]) == 0
    assert "1 held-out views: PSNR" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["steps"] == 2
    assert (out / "renders" / "test" / "r_0.png").is_file()
    assert main(["render", str(out), "--path", "orbit", "--format", "gif", "--frames", "2", "--threads", "1"]) == 0
    assert (out / "renders" / "orbit.gif").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "{in}", "-o", "{out}", "--budget", "soon"], "--budget soon"),
        (["train", "{in}/train", "-o", "{out}"], "no posed photos"),
        (["train", "{in}", "-o", "{out}", "--field", "tiny", "--device", "abacus"], "--device cpu"),
        (["train", "{in}", "-o", "{out}", "--device", "abacus"], "--device cpu"),
        (["render", "{in}"], "fieldstone train"),
    ],
)
def test_mistakes_end_in_one_line(blender_folder, tmp_path, capsys, arguments, message):
    pytest.importorskip("torch")
    places = {"{in}": str(blender_folder), "{out}": str(tmp_path / "out")}
    for mark, place in places.items():
        arguments = [argument.replace(mark, place) for argument in arguments]
    assert main(arguments) == 3
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("text", "expected"), [("300s", 300), ("10m", 600), ("1.5h", 5400), ("42", 42)])
def test_budgets(text, expected):
    assert seconds(text) == expected


@pytest.mark.parametrize("text", ["", "s", "-3s", "0", "nan", "infs", "3d"])
def test_bad_budgets(text):
    with pytest.raises(InputError, match="`budget_s`"):
        seconds(text)
