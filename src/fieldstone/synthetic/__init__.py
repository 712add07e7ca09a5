"""Worlds with known answers: scenes of points and cameras, photos of a small building, analytic fields."""
