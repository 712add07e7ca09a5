"""The order of the stages: from photos to a scene, from a scene to a field, and to what is made of it."""
