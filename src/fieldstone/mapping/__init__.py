"""A match graph to reconstructions."""
