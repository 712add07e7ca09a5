import numpy as np
import pytest
from safetensors.numpy import save_file

from fieldstone.errors import InputError
from fieldstone.io.files.checkpoint import read_checkpoint, write_checkpoint

TENSORS = {
    "weights": np.random.default_rng(0).standard_normal((7, 3)).astype(np.float32),
    "poses": np.random.default_rng(1).standard_normal((2, 3, 4)),
    "step": np.array(12),
}
HEADER = {"field": "tiny", "near": 2.0, "names": ["a", "ä"], "size": None}


def test_round_trip_is_exact_and_repeatable(tmp_path):
    path = tmp_path / "run" / "checkpoint.safetensors"
    write_checkpoint(path, TENSORS, HEADER)
    first = path.read_bytes()
    tensors, header = read_checkpoint(path)
    assert header == HEADER
    assert set(tensors) == set(TENSORS)
    for name, expected in TENSORS.items():
        np.testing.assert_array_equal(tensors[name], expected)
        assert (tensors[name].dtype, tensors[name].shape) == (expected.dtype, expected.shape)
    write_checkpoint(path, dict(reversed(TENSORS.items())), HEADER)
    assert path.read_bytes() == first
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.safetensors"]


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, TENSORS, HEADER)
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match="checkpoint"):
            read_checkpoint(path)


def test_every_flipped_byte_is_refused(tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    write_checkpoint(path, TENSORS, HEADER)
    whole = path.read_bytes()
    for position in range(len(whole)):
        damaged = bytearray(whole)
        damaged[position] ^= 0x20
        path.write_bytes(bytes(damaged))
        with pytest.raises(InputError, match="checkpoint"):
            read_checkpoint(path)


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="fieldstone train"):
        read_checkpoint(tmp_path / "none.safetensors")
    save_file({"a": np.zeros(3)}, tmp_path / "foreign.safetensors")
    with pytest.raises(InputError, match="no fieldstone checkpoint"):
        read_checkpoint(tmp_path / "foreign.safetensors")
