"""Data sets with given matches."""
