"""`fieldstone mesh`."""

from fieldstone.cli.field_verbs import mesh

__all__ = ["mesh"]
