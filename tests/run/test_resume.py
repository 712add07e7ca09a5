"""Killed runs go on and end with the same bytes."""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import fieldstone

RUN = """
import os, resource, signal, sys
from pathlib import Path
from fieldstone.run import scene as module
from fieldstone.cli import main

writes_left, largest_file, original = int(sys.argv[1]), int(sys.argv[2]), Path.replace
if largest_file:
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

def replace(self, target):
    global writes_left
    writes_left -= 1
    if writes_left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return original(self, target)

Path.replace = replace
module.mapping_figures = lambda run, photo_of: []  # drawing takes longer than all the rest
sys.exit(main(["reconstruct", *sys.argv[3:]]))
"""


def start(
    photos: Path,
    out: Path,
    *options: str,
    kill_at_write: int = 0,
    largest_file: int = 0,
    threads: int = 2,
    stderr: int = subprocess.DEVNULL,
) -> subprocess.Popen[str]:
    """A run in a process of its own.

    Args:
        kill_at_write: The write of this number kills the process before the file is there; 0: none does.
        largest_file: In bytes; writing more fails as on a full disk. 0: no limit.
    """
    source = str(Path(fieldstone.__file__ or "").parents[1])
    numbers = [str(kill_at_write), str(largest_file)]
    command = [sys.executable, "-c", RUN, *numbers, str(photos), "-o", str(out), "--threads", str(threads), *options]
    libraries = {"OPENBLAS_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
    environment = {**os.environ, **libraries, "PYTHONPATH": source}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=stderr, env=environment, text=True)


def results(out: Path) -> dict[str, str]:
    """Hashes of the model, and all that run.json says but the seconds and the place of the photos."""
    record = json.loads((out / "run.json").read_text())
    del record["seconds"], record["photos_folder"], record["input"]
    files = [*(out / "sparse").rglob("*.bin"), out / "points.ply"]
    hashes = {str(p.relative_to(out)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
    return hashes | {"run.json": json.dumps(record, indent=1)}


@pytest.fixture(scope="module")
def uninterrupted(house_photos, tmp_path_factory) -> Path:
    """A run that was not stopped."""
    out = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert start(house_photos, out).wait() == 0
    return out


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 6))])
def test_a_run_killed_while_writing_ends_with_the_same_bytes(house_photos, uninterrupted, tmp_path, seed):
    """Six writes keep features, one matches, one their geometry, four states of the mapper; then come the results."""
    for write in np.random.default_rng(seed).integers(1, 16, size=2).tolist():
        assert start(house_photos, tmp_path / "out", kill_at_write=write).wait() in (-signal.SIGKILL, 0)
    assert start(house_photos, tmp_path / "out").wait() == 0
    assert results(tmp_path / "out") == results(uninterrupted)
    assert not list((tmp_path / "out").rglob(".writing-*"))
    assert not (tmp_path / "out" / "work" / "lock").exists()
    assert not list((tmp_path / "out" / "work").rglob("mapper/*"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_a_run_killed_at_any_time_ends_with_the_same_bytes(house_photos, uninterrupted, tmp_path, seed):
    began = time.perf_counter()
    assert start(house_photos, tmp_path / "whole").wait() == 0
    whole_s = time.perf_counter() - began
    for share in np.random.default_rng([7, seed]).random(4):
        process = start(house_photos, tmp_path / "out")
        time.sleep(share * whole_s)
        process.kill()
        process.wait()
    assert start(house_photos, tmp_path / "out").wait() == 0
    assert results(tmp_path / "out") == results(uninterrupted)
    assert not list((tmp_path / "out").rglob(".writing-*"))


@pytest.mark.parametrize("threads", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_any_number_of_threads_gives_the_same_bytes(house_photos, uninterrupted, tmp_path, threads):
    assert start(house_photos, tmp_path / "out", threads=threads).wait() == 0
    assert results(tmp_path / "out") == results(uninterrupted)
    kept = {p.relative_to(uninterrupted): p.read_bytes() for p in (uninterrupted / "work").rglob("*.safetensors")}
    assert {
        p.relative_to(tmp_path / "out"): p.read_bytes() for p in (tmp_path / "out" / "work").rglob("*.safe*")
    } == kept


def test_a_full_disk_is_one_clear_error_and_no_half_file(house_photos, uninterrupted, tmp_path):
    largest = sum(p.stat().st_size for p in (uninterrupted / "work" / "units" / "features").iterdir()) // 6
    with start(house_photos, tmp_path / "out", largest_file=largest, stderr=subprocess.PIPE) as process:
        _, errors = process.communicate()
    assert process.returncode == 5
    assert len(errors.splitlines()) == 1
    assert "free space or choose another output" in errors
    assert not list((tmp_path / "out").rglob(".writing-*"))
    assert start(house_photos, tmp_path / "out").wait() == 0
    assert results(tmp_path / "out") == results(uninterrupted)


def changed(before: dict[str, int], out: Path) -> set[str]:
    """Kept files that are new since `before`, by stage."""
    return {p.parent.name for p in (out / "work").rglob("*.safetensors") if before.get(str(p)) != p.stat().st_mtime_ns}


def times(out: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in (out / "work").rglob("*.safetensors")}


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        pytest.param("nothing", set(), marks=pytest.mark.slow),
        pytest.param("seed", {"two_views"}, marks=pytest.mark.slow),
        pytest.param("size", {"features", "matches", "two_views"}, marks=pytest.mark.slow),
        ("photo", {"matches", "two_views"}),
        pytest.param("fresh", {"features", "matches", "two_views"}, marks=pytest.mark.slow),
        ("damage", {"features"}),
    ],
)
def test_a_change_undoes_only_what_depends_on_it(house_photos, uninterrupted, tmp_path, case, expected):
    photos, out = tmp_path / "photos", tmp_path / "out"
    shutil.copytree(house_photos, photos)
    shutil.copytree(uninterrupted, out)
    options = {"seed": ("--seed", "1"), "size": ("--max-image-size", "300"), "fresh": ("--fresh",)}.get(case, ())
    if case == "photo":  # a name is not what features depend on
        (photos / "house_05.jpg").unlink()
        shutil.copy(photos / "house_00.jpg", photos / "copy.jpg")
    if case == "damage":
        path = next((out / "work").rglob("features/*.safetensors"))
        path.write_bytes(path.read_bytes()[:-1])
    before = times(out)
    assert start(photos, out, *options).wait() == 0
    assert changed(before, out) == expected
    if case in ("nothing", "fresh", "damage"):
        assert results(out) == results(uninterrupted)
