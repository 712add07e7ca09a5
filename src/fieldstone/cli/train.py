"""`fieldstone train`."""

from fieldstone.cli.field_verbs import train

__all__ = ["train"]
