"""A reconstruction and its photos to a radiance field."""
