"""Estimation on arrays: minimal and linear solvers, RANSAC, least squares, bundle adjustment."""
