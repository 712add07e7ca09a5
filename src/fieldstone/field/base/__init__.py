"""What all fields share: rays to learn from, the loop of training, volume rendering."""
