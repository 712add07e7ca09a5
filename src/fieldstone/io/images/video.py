"""Frames to films: MP4 (H.264) and GIF, one frame in memory at a time for MP4, whole files or none."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from fieldstone.errors import InputError
from fieldstone.io.files.atomic import replacing

Frame = UInt8[np.ndarray, "h w 3"]


def write_mp4(path: Path, frames: Iterable[Frame], *, fps: int = 30, crf: int = 18) -> int:
    """Write an H.264 film that every player opens (yuv420p), and return the number of frames.

    Frames of odd width or height are extended by a copy of their last column or row, because the colour planes of
    yuv420p have half the size.

    Args:
        crf: Quality, 0 (lossless) to 51; 18 is free of visible loss.

    Raises:
        InputError: No frame, or frames of different sizes.
    """
    count, shape = 0, None
    with replacing(path) as temporary, av.open(str(temporary), mode="w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": str(crf), "threads": "1"})
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            if shape is None:
                shape = frame.shape
                stream.height, stream.width = shape[0] + shape[0] % 2, shape[1] + shape[1] % 2
            _check_frame(path, frame, shape)
            even = np.pad(frame, ((0, shape[0] % 2), (0, shape[1] % 2), (0, 0)), mode="edge")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
            count += 1
        if shape is None:
            raise InputError(f"{path}: a film needs at least one frame")
        container.mux(stream.encode())
    return count


def write_gif(path: Path, frames: Iterable[Frame], *, fps: int = 30) -> int:
    """Write an endless GIF, and return the number of frames. A GIF has 256 colours per frame.

    Raises:
        InputError: No frame, or frames of different sizes.
    """
    images: list[Image.Image] = []
    shape = None
    for frame in frames:
        shape = frame.shape if shape is None else shape
        _check_frame(path, frame, shape)
        images.append(Image.fromarray(frame).quantize(256, method=Image.Quantize.MEDIANCUT))
    if not images:
        raise InputError(f"{path}: a film needs at least one frame")
    with replacing(path) as temporary:
        # GIF counts in hundredths of a second; players slow down anything shorter than two of them.
        duration_ms = max(20, 10 * round(100 / fps))
        images[0].save(
            temporary, format="GIF", save_all=True, append_images=images[1:], duration=duration_ms, loop=0, disposal=1
        )
    return len(images)


def _check_frame(path: Path, frame: Frame, shape: tuple[int, ...]) -> None:
    if frame.shape != shape:
        raise InputError(f"{path}: frames of one film must have one size, got {shape} and {frame.shape}")
