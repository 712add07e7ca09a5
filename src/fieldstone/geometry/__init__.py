"""Pure mathematics on arrays: rotations, transforms, cameras, epipolar geometry, triangulation."""
