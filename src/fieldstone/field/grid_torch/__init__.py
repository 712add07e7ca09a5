"""Training of the grid field by autograd, on any device of torch."""
