"""The classical networks: the original NeRF, and the small one of the course."""
