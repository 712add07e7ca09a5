"""Names of photos that come out of files, and what they must not do."""

from __future__ import annotations

import re

MAX_NAME_BYTES = 4096


def name_problem(name: str) -> str | None:
    """Why a photo's name from a model or JSON file cannot be used; None if it can.

    A name is a relative path that stays below the photo folder, on any system, and prints on one line.
    """
    parts = re.split(r"[/\\]", name)
    if not name:
        return "the name is empty"
    if len(name.encode(errors="replace")) > MAX_NAME_BYTES:
        return f"the name is longer than {MAX_NAME_BYTES} bytes"
    if not name.isprintable():
        return f"the name {name[:40]!r} has control characters"
    if ".." in parts or parts[0] == "" or re.match(r"[A-Za-z]:", name):
        return f"the name {name[:40]!r} leads out of the photo folder"
    return None
