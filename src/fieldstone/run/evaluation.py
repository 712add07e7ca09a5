"""Held-out views of a field, rendered and measured against their photos."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from fieldstone.evaluate.image_metrics import PROTOCOL, psnr, quantize, ssim
from fieldstone.field.base.radiance_field import RayRenderer
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.images.photos import pixels_of_png, png_bytes
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.records.field import ViewScores
from fieldstone.rendering.views import render_view
from fieldstone.run.field_input import view_labels
from fieldstone.scene.photos import DecodedPhotos

logger = logging.getLogger(__name__)

MAX_PSNR = 100.0
"""What an image that is equal at 8 bits counts as, in dB: JSON has no infinity."""

ExposureAt = Callable[[Rigid3], Float[np.ndarray, "3"]]
"""Gain of each channel with which a view from a pose (`cam_from_world`) is shown."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """How alike held-out views and their photos are, and the views themselves."""

    scores: Mapping[str, ViewScores] = field(default_factory=dict)
    """By label."""
    views: Mapping[str, bytes] = field(default_factory=dict)
    """The rendered views as PNG files, by label."""
    protocol: str = "no held-out views"
    """How they were compared."""

    @property
    def psnr(self) -> float | None:
        """Mean over the views, in dB; None without any."""
        return float(np.mean([view.psnr for view in self.scores.values()])) if self.scores else None

    @property
    def ssim(self) -> float | None:
        """Mean over the views; None without any."""
        return float(np.mean([view.ssim for view in self.scores.values()])) if self.scores else None

    def view(self, label: str) -> UInt8[np.ndarray, "h w 3"]:
        """The pixels of a rendered view."""
        return pixels_of_png(self.views[label])


def evaluate(
    render_rays: RayRenderer,
    photos: DecodedPhotos,
    background: Float[np.ndarray, "3"],
    exposure: ExposureAt | None = None,
    on_progress: OnProgress = silent,
) -> Evaluation:
    """Render the view of every photo and compare the two, where its mask is white.

    Args:
        render_rays: The field, in the world.
        background: What photos with transparency are shown on.
        exposure: None: views are shown as they are.
    """
    scores: dict[str, ViewScores] = {}
    views: dict[str, bytes] = {}
    stage = StageProgress(on_progress, "rendering held-out views", len(photos))
    for v, label in enumerate(view_labels(photos.posed.names)):
        pose = photos.posed.pose_of(v)
        color = render_view(render_rays, photos.posed.camera_of(v), pose).rgb
        rendered = quantize(color if exposure is None else color * exposure(pose))
        views[label] = png_bytes(rendered)
        as_written = rendered.astype(np.float32) / np.float32(255.0)
        photo, keep = photos.composited(v, background), photos.keep[v]
        if keep is not None and not keep.any():
            logger.warning("%s: its mask keeps nothing, so its view is not measured", photos.posed.names[v])
            stage.advance()
            continue
        found = min(psnr(as_written, photo, keep), MAX_PSNR)
        scores[label] = ViewScores(float(found), float(ssim(as_written, photo, keep)))
        stage.advance()
    return Evaluation(scores, views, _protocol(photos, background, exposure is not None))


def _protocol(photos: DecodedPhotos, background: Float[np.ndarray, "3"], with_exposure: bool) -> str:
    sizes = sorted({(camera.width, camera.height) for camera in photos.posed.cameras})
    levels = ", ".join(f"{255 * c:.0f}" for c in background)
    return (
        f"{len(photos)} held-out views of {' and '.join(f'{w}x{h}' for w, h in sizes) or 'no'} pixels; "
        f"background ({levels}); {PROTOCOL}; equal images count as {MAX_PSNR:.0f} dB"
        + ("; shown with the exposure of the training photos nearest to them" if with_exposure else "")
        + ("; only where masks are white" if any(keep is not None for keep in photos.keep) else "")
    )
