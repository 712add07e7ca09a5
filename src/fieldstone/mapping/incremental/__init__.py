"""Incremental registration: from an initial pair, photo by photo."""
