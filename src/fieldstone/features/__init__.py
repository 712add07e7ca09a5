"""Images to features, features to a match graph."""
