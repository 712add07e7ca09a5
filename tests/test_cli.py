"""The console script as a process of its own: it leaves without taking its libraries apart."""

import subprocess
import sys

import pytest

from fieldstone import __version__

COMMAND = [sys.executable, "-m", "fieldstone.cli"]


@pytest.mark.parametrize(
    ("arguments", "code", "out", "err"),
    [
        (["--version"], 0, f"fieldstone {__version__}\n", ""),
        (["reconstruct", "nowhere", "-o", "out"], 3, "", "nowhere: no such folder"),
        (["reconstruct"], 2, "", "Missing"),
    ],
)
def test_exit_codes_and_all_output_come_through(tmp_path, arguments, code, out, err):
    done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == code
    assert done.stdout == out
    assert err in done.stderr
    assert "Traceback" not in done.stderr


def test_a_reader_that_has_seen_enough_is_no_error(tmp_path):
    process = subprocess.Popen([*COMMAND, "--version"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    error = process.stderr.read()
    process.stderr.close()
    process.wait()
    assert "Traceback" not in error
