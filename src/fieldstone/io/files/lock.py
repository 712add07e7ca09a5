"""One writer per output folder."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import TEMPORARY_PREFIX

LOCK = "lock"


@contextmanager
def sole_writer(out: Path) -> Iterator[Path]:
    """Hold `out` for this process; what a killed one left half-written is removed first.

    The system lets go of the lock when its process ends, however it ends: there is no stale lock. Folders that were
    made for the lock and stay empty go again.

    Yields:
        `out/work`, the folder for what the run keeps.

    Raises:
        InputError: Another process writes to `out`, or it is no folder that can be written.
    """
    work = out / "work"
    empty_ones = (work,) if out.exists() else (work, out)
    try:
        work.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{work}: cannot be made, a file has that name; choose another output") from error
    file = _locked(work / LOCK, out)
    try:
        remove_abandoned(out)
        yield work
    finally:
        (work / LOCK).unlink(missing_ok=True)
        file.close()
        for folder in empty_ones:
            with suppress(OSError):
                folder.rmdir()


def remove_abandoned(folder: Path) -> None:
    """Delete the temporary files of processes that no longer run."""
    for path in folder.rglob(f"{TEMPORARY_PREFIX}*"):
        match = re.match(rf"{re.escape(TEMPORARY_PREFIX)}(\d+)-", path.name)
        if match and not _other_process_runs(int(match[1])):
            path.unlink(missing_ok=True)


def _locked(path: Path, out: Path) -> IO[str]:
    """The lock file, open and locked; its text is the process id."""
    while True:
        file = path.open("a+", encoding="utf-8")
        if not _try_lock(file):
            file.seek(0)
            holder = file.read().strip() or "unknown"
            file.close()
            raise InputError(
                f"{out}: process {holder} is writing there; wait until it ends, stop it, or choose another output"
            )
        # Its holder may have deleted it between opening and locking: then this is a lock on nothing.
        with suppress(FileNotFoundError):
            if os.fstat(file.fileno()).st_ino == path.stat().st_ino:
                file.truncate(0)
                file.write(f"{os.getpid()}\n")
                file.flush()
                return file
        file.close()


def _try_lock(file: IO[str]) -> bool:
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(1 << 20)  # beyond the text, which stays readable to others
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _other_process_runs(pid: int) -> bool:
    """Whether a process other than this one has the number; where asking is not possible, it has not."""
    if pid == os.getpid() or sys.platform == "win32":
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
