"""The one error that a user's mistake ends in."""

from __future__ import annotations


class InputError(Exception):
    """Input that cannot be used: what, where, why, and what to do next, in one message.

    The command line prints the message without a traceback and ends with exit code 3.
    """
