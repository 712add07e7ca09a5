"""`fieldstone VERB ...`: finds the verb, runs it, and says in one line what went wrong.

Exit codes: 0 good, 2 usage, 3 bad input, 4 no model, 5 disk or memory, 130 interrupted.
"""

from __future__ import annotations

import gc
import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NoReturn

import tyro

from fieldstone import __version__
from fieldstone.errors import InputError

GC_THRESHOLD = 100_000
"""New objects between two collections."""

VERBS = {
    "demo": "The whole road on photos of a small house that the package makes itself, and what it misses the truth by.",
    "reconstruct": "Camera poses and a point cloud from photos, or from given matches.",
    "train": "A radiance field from posed photos, and its held-out views measured.",
    "render": "A film of a trained field.",
    "mesh": "A coloured mesh of a trained fast field, and how well it agrees with the field.",
    "splat": "Gaussian splats (PLY) of a trained fast field, and how much they look like it.",
    "report": "Write report.html of a folder anew, from what lies in it.",
}
"""Each verb is the function of that name in the module of that name in this folder. They are told here as well, so
that help and usage errors come before anything heavy is loaded."""

FLAGS = {"budget_s": "budget"}
"""Options that are called otherwise on the command line."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb and return its exit code; a user's mistake ends in one line on stderr."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        sys.stdout.write(f"fieldstone {__version__}\n")
        return 0
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s", stream=sys.stderr)
    try:
        return tyro.extras.subcommand_cli_from_dict(
            _verbs(arguments),
            args=arguments,
            prog="fieldstone",
            description="Photos in, a scene that you can walk through out.",
        )
    except InputError as error:
        sys.stderr.write(f"fieldstone: {spelled(str(error))}\n")
        return 3
    except MemoryError:
        sys.stderr.write("fieldstone: out of memory; use fewer or smaller photos, or close other programs\n")
        return 5
    except OSError as error:
        sys.stderr.write(
            f"fieldstone: {error.filename or 'disk'}: {error.strerror or error}; free space or choose another output\n"
        )
        return 5
    except KeyboardInterrupt:
        sys.stderr.write("fieldstone: interrupted; what was finished is kept\n")
        return 130


def spelled(message: str) -> str:
    """A message of the library, with its options as they are typed here: `like_this` becomes --like-this."""
    return re.sub(r"`([a-z_]+)`", lambda name: "--" + FLAGS.get(name[1], name[1]).replace("_", "-"), message)


def _verbs(arguments: Sequence[str]) -> dict[str, Callable[..., int]]:
    """The verb that is typed, loaded; of the others no more than their help."""
    typed = arguments[0] if arguments else None
    return {
        verb: getattr(import_module(f"fieldstone.cli.{verb}"), verb) if verb == typed else _described(text)
        for verb, text in VERBS.items()
    }


def _described(text: str) -> Callable[[], int]:
    def verb() -> int:
        raise AssertionError("only the verb that is typed runs")

    verb.__doc__ = text
    return verb


def run() -> NoReturn:
    """The console script: `main`, then out at once.

    Everything is written and no thread is left; taking numba and LLVM apart in order would last another 0.2 s. The
    default threshold of the garbage collector would have it look through all modules again and again while they load.
    """
    gc.set_threshold(GC_THRESHOLD)
    try:
        code = main()
        sys.stdout.flush()
    except BrokenPipeError:  # who read the output has seen enough
        code = 0
    logging.shutdown()
    sys.stderr.flush()
    os._exit(code)
