"""Pairs that match without showing the same place."""
