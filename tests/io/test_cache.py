"""Kept units: what comes back, what a change invalidates, damaged files."""

from collections.abc import Iterator, Sequence

import numpy as np
import pytest

from fieldstone.features.sift import SiftOptions
from fieldstone.io.files import cache as module
from fieldstone.io.files.cache import Packing, Unit, UnitCache, file_hash, key_of, resumed

PACKING = Packing(lambda value: Unit({"value": value}, {"size": len(value)}), lambda unit: unit.arrays["value"])


class Counting:
    """Squares arrays, and notes which."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def __call__(self, items: Sequence[int]) -> Iterator[np.ndarray]:
        for item in items:
            self.seen.append(item)
            yield np.arange(item) ** 2


def run(cache: UnitCache, items: list[int], work: Counting) -> list[np.ndarray]:
    return resumed(cache, "squares", [key_of("square", item) for item in items], items, work, PACKING)


def test_a_unit_comes_back_bit_for_bit(tmp_path):
    arrays = {
        "pixels": np.random.default_rng(0).normal(size=(5, 2)),
        "empty": np.empty((0, 2), dtype=np.int64),
        "mask": np.array([True, False, True]),
    }
    cache = UnitCache(tmp_path)
    cache.keep("stage", "key", Unit(arrays, {"kind": "planar", "number": 0.1}))
    unit = cache.find("stage", "key")
    assert unit is not None
    assert unit.facts == {"kind": "planar", "number": 0.1}
    for name, array in arrays.items():
        assert unit.arrays[name].dtype == array.dtype
        assert unit.arrays[name].flags.writeable
        np.testing.assert_array_equal(unit.arrays[name], array, strict=True)
    assert cache.find("stage", "other") is None
    assert cache.find("other", "key") is None


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    work = Counting()
    run(UnitCache(), [3, 4], work)
    run(UnitCache(), [3, 4], work)
    assert work.seen == [3, 4, 3, 4]
    assert not list(tmp_path.iterdir())


def test_only_what_is_missing_is_done(tmp_path):
    cache, work = UnitCache(tmp_path), Counting()
    run(cache, [3, 4, 5], work)
    values = run(cache, [5, 6, 3], work)
    assert work.seen == [3, 4, 5, 6]
    for value, size in zip(values, [5, 6, 3], strict=True):
        np.testing.assert_array_equal(value, np.arange(size) ** 2)
    # What does not belong to the last run is gone, and the rest lies in one file.
    assert set(cache.find_all("squares")) == {key_of("square", k) for k in (5, 6, 3)}
    assert len(list((tmp_path / "squares").iterdir())) == 1


@pytest.mark.parametrize("stopped_at", [0, 1, 4, 5, 9, 10])
def test_a_stopped_stage_loses_at_most_one_batch(tmp_path, monkeypatch, stopped_at):
    monkeypatch.setattr(module, "BATCH", 4)
    cache, work = UnitCache(tmp_path), Counting()
    items = list(range(1, 11))

    def stopping(some: Sequence[int]) -> Iterator[np.ndarray]:
        for value in work(some):
            if len(work.seen) > stopped_at:
                raise KeyboardInterrupt
            yield value

    keys = [key_of("square", item) for item in items]
    if stopped_at < len(items):
        with pytest.raises(KeyboardInterrupt):
            resumed(cache, "squares", keys, items, stopping, PACKING)
    assert len(cache.find_all("squares")) == (stopped_at // 4 * 4 if stopped_at < 10 else 0)
    again = Counting()
    values = run(cache, items, again)
    assert again.seen == items[stopped_at // 4 * 4 if stopped_at < 10 else 0 :]
    for value, size in zip(values, items, strict=True):
        np.testing.assert_array_equal(value, np.arange(size) ** 2)


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "another file", "header"])
def test_damaged_files_are_made_anew(tmp_path, damage):
    cache, work = UnitCache(tmp_path), Counting()
    run(cache, [300, 400], work)
    (path,) = (tmp_path / "squares").iterdir()
    data = bytearray(path.read_bytes())
    match damage:
        case "truncated":
            data = data[: len(data) // 2]
        case "flipped":
            data[-100] ^= 4
        case "empty":
            data = bytearray()
        case "another file":
            data = bytearray(b"hello" * 100)
        case "header":
            data[3] ^= 0xFF
    path.write_bytes(bytes(data))
    values = run(cache, [300, 400], work)
    assert work.seen == [300, 400, 300, 400]
    np.testing.assert_array_equal(values[1], np.arange(400) ** 2)
    assert set(cache.find_all("squares")) == {key_of("square", 300), key_of("square", 400)}


def test_keys_follow_content():
    same = key_of("a", 1, 0.1, [1, 2], SiftOptions(), np.arange(3))
    assert same == key_of("a", 1, 0.1, (1, 2), SiftOptions(), np.arange(3))
    others = [
        key_of("a", 1, 0.1, [1, 2], SiftOptions(max_features=4999), np.arange(3)),
        key_of("a", 1, 0.1, [1, 2], SiftOptions(), np.arange(3.0)),
        key_of("a", 1, np.nextafter(0.1, 1), [1, 2], SiftOptions(), np.arange(3)),
        key_of("a1", 0.1, [1, 2], SiftOptions(), np.arange(3)),
    ]
    assert len({same, *others}) == 5
    with pytest.raises(TypeError, match="object"):
        key_of(object())


def test_file_hash_is_that_of_the_bytes(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert file_hash(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
