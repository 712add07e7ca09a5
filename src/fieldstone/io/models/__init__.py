"""Reconstructions in the formats of others."""
