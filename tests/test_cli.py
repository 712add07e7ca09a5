"""The console script as a process of its own: it leaves without taking its libraries apart."""

import inspect
import subprocess
import sys
from importlib import import_module

import pytest

from fieldstone import __version__
from fieldstone.cli import main
from fieldstone.cli.main import VERBS

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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["reconstruct", "{in}", "-o", "out", "--max-image-size", "0"], "--max-image-size must be at least 1, got 0"),
        (["reconstruct", "{in}", "-o", "out", "--threads", "-1"], "--threads must be at least 0, got -1"),
        (["reconstruct", "{in}", "-o", "out", "--camera-model", "OPENCV"], "--camera-model OPENCV needs --intrinsics"),
        (["reconstruct", "{in}", "-o", "out", "--intrinsics", "one,2"], "--intrinsics one,2: give numbers with commas"),
        (["train", "{in}", "-o", "out", "--memory", "-1"], "--memory must be positive, got -1"),
        (["train", "{in}", "-o", "out", "--steps", "0"], "--steps must be at least 1, got 0"),
        (["train", "{in}", "-o", "out", "--steps", "-1"], "--steps must be at least 1, got -1"),
        (["train", "{in}", "-o", "out", "--budget", "soon"], "--budget soon: give a positive time"),
        (
            ["train", "{in}", "-o", "out", "--field", "tiny", "--refine-poses"],
            "--refine-poses belongs to the fast field",
        ),
        (["render", "{in}", "--fps", "0"], "--fps must be at least 1, got 0"),
        (["mesh", "{in}", "--level", "1"], "--level must lie between 0 and 1, got 1"),
    ],
)
def test_mistakes_in_options_are_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    assert main([argument.replace("{in}", "in") for argument in arguments]) == 3
    error = capsys.readouterr().err
    assert error.startswith(f"fieldstone: {message}")
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_is_its_own_and_says_what_the_list_says(verb):
    """The list is told without loading the verbs, so that it comes at once."""
    function = getattr(import_module(f"fieldstone.cli.{verb}"), verb)
    told = inspect.getdoc(function)
    assert told is not None
    assert told.split("\n\n")[0].replace("\n", " ") == VERBS[verb]


def test_help_loads_nothing_heavy():
    code = "import sys; from fieldstone.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('numpy', 'numba', 'cv2', 'scipy', 'torch') if m in sys.modules], file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(verb in done.stdout for verb in VERBS)
    assert done.stderr == "[]\n"
