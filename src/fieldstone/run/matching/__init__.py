"""From photos to a verified match graph."""
