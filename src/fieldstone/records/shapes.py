"""What is written of a mesh and of splats made from a field."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshRecord:
    """`mesh.json`: the size of a mesh, and its agreement with the field in views of training photos."""

    path: str
    vertices: int
    faces: int
    floaters_removed: int
    closed: bool
    silhouette_iou: float
    """Intersection over union of what is solid."""
    depth_error_median_percent: float | None
    """None where nothing can be compared."""
    compared: str
    """In which views, and how."""


@dataclass(frozen=True)
class SplatRecord:
    """`splats.json`: how many splats there are, and how much they look like the field."""

    path: str
    splats: int
    psnr_to_field: float | None
    """Mean over views, in dB; None where no view can be compared."""
    compared: str
