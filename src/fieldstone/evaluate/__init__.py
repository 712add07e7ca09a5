"""Numbers about results: image metrics and reconstruction metrics."""
