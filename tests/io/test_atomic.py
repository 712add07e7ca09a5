"""Files appear whole or not at all."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import replacing, write_bytes, write_json, write_together


def test_replacing_writes_the_whole_file_with_ordinary_permissions(tmp_path):
    target = tmp_path / "new" / "clip.mp4"
    with replacing(target) as temporary:
        assert temporary.suffix == ".mp4"
        assert temporary.parent == target.parent
        temporary.write_bytes(b"frames")
        assert not target.exists()
    assert target.read_bytes() == b"frames"
    plain = tmp_path / "plain"
    plain.write_bytes(b"")
    assert target.stat().st_mode == plain.stat().st_mode
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_error_leaves_the_old_file_and_no_other(tmp_path, error):
    target = tmp_path / "a.bin"
    write_bytes(target, b"old")

    def fail_half_way():
        with replacing(target) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(error):
        fail_half_way()
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_write_together_replaces_all_or_none(tmp_path):
    write_together(tmp_path / "model", {"a": b"1", "b": b"2"})
    assert {p.name: p.read_bytes() for p in (tmp_path / "model").iterdir()} == {"a": b"1", "b": b"2"}

    class Interrupted(dict[str, bytes]):
        def __getitem__(self, name):
            if name == "b":
                raise KeyboardInterrupt
            return b"3"

    with pytest.raises(KeyboardInterrupt):
        write_together(tmp_path / "model", Interrupted(a=b"3", b=b""))
    assert {p.name: p.read_bytes() for p in (tmp_path / "model").iterdir()} == {"a": b"1", "b": b"2"}


def test_a_folder_in_the_way_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="a file has that name"):
        write_bytes(tmp_path / "file" / "out.json", b"")
    with pytest.raises(InputError, match="a folder has that name"):
        write_bytes(tmp_path, b"")


def test_json_holds_what_was_given_and_refuses_nan(tmp_path):
    @dataclass(frozen=True)
    class Row:
        stage: str
        error_px: float

    value = {"rows": [Row("pnp", 0.1)], "n": np.int64(3), "a": np.array([1.5, 2.0]), "p": Path("x/ü"), "ok": np.True_}
    write_json(tmp_path / "run.json", value)
    read = json.loads((tmp_path / "run.json").read_text(encoding="utf-8"))
    assert read == {"rows": [{"stage": "pnp", "error_px": 0.1}], "n": 3, "a": [1.5, 2.0], "p": "x/ü", "ok": True}
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "run.json", {"psnr": float("inf")})
    assert json.loads((tmp_path / "run.json").read_text(encoding="utf-8")) == read
