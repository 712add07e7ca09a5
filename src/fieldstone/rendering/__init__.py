"""A radiance field to views, camera paths and meshes."""
