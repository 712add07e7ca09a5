"""One writer per folder, and what dead ones left."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from fieldstone.errors import InputError
from fieldstone.io.files.lock import sole_writer

HOLD = """
import sys, time
from pathlib import Path
from fieldstone.io.files.lock import sole_writer
from fieldstone.io.files.atomic import replacing
with sole_writer(Path(sys.argv[1])) as work, replacing(work / "half.bin"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    source = str(Path(sys.modules["fieldstone"].__file__ or "").parents[1])
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path / "out")],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": source},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_writer_is_refused_at_once_and_a_dead_one_is_no_hindrance(tmp_path, holder):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=f"process {holder.pid} is writing"), sole_writer(out):
        pass
    assert holder.poll() is None
    assert list(out.rglob(".writing-*"))
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with sole_writer(out) as work:
        assert work.is_dir()
        assert not list(out.rglob(".writing-*"))
    with sole_writer(out):
        pass


def test_what_other_processes_write_is_left_alone(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    parent = out / f".writing-{os.getppid()}-abc.json"
    parent.write_text("")
    foreign = out / ".writing-notes.txt"
    foreign.write_text("")
    with sole_writer(out):
        assert parent.exists()
        assert foreign.exists()


def test_folders_made_for_the_lock_go_again(tmp_path):
    with sole_writer(tmp_path / "a" / "out"):
        pass
    assert not (tmp_path / "a" / "out").exists()
    with sole_writer(tmp_path / "b") as work:
        (work / "kept").write_text("")
    assert [p.name for p in (tmp_path / "b" / "work").iterdir()] == ["kept"]


def test_an_output_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="choose another output"), sole_writer(tmp_path / "out"):
        pass
