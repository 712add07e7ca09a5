"""Files as such: whole or not at all, locked, named, kept."""
