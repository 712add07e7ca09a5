"""What photos and known points say of a scene besides colour."""
