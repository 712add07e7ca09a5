"""Camera models, compiled."""
