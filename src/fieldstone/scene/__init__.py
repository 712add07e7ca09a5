"""The nouns: features, match graphs, tracks, reconstructions, rays, meshes."""
