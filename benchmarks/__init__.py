"""Ours against the peers, timed as ratios within one run: `python -m benchmarks.sfm --help` and its siblings."""
