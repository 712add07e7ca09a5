"""Estimation from data of which a part is false: RANSAC, robust losses, two views, absolute pose, tracks."""
