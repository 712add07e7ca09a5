"""`fieldstone report OUT`."""

from __future__ import annotations

from fieldstone.cli.console import Source, plain_console


def report(source: Source, /) -> int:
    """Write report.html of a folder anew, from what lies in it.

    Args:
        source: Folder that reconstruct, train or demo wrote.
    """
    from fieldstone.run.folder import RunFolder

    folder = RunFolder(source)
    story = folder.read_story()
    with folder.sole_writer():
        folder.write_report(story)
    plain_console().print(f"open {folder.report}", markup=False)
    return 0
