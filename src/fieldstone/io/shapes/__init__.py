"""Points, meshes and splats."""
