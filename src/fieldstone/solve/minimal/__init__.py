"""Solvers from as few correspondences as determine the answer, and the linear ones of the textbook."""
