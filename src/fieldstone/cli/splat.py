"""`fieldstone splat`."""

from fieldstone.cli.field_verbs import splat

__all__ = ["splat"]
