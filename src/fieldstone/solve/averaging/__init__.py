"""All cameras at once: rotations from relative ones, then positions."""
