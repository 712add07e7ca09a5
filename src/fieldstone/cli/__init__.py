"""The command `fieldstone`: one file a verb, whose options the Python API shares."""

from fieldstone.cli.main import main, run

__all__ = ["main", "run"]
