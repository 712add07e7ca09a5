"""`fieldstone render`."""

from fieldstone.cli.field_verbs import render

__all__ = ["render"]
