"""`python -m fieldstone.cli`: the console script."""

from fieldstone.cli import run

run()
