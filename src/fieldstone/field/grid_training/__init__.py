"""Training of the grid field on the CPU, within a time budget."""
