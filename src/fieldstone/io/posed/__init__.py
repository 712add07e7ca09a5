"""Posed photos in the formats of others."""
