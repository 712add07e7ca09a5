"""Photos with cameras and poses as one table by index: as files list them, and decoded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photo i is called names[i], was taken by cameras[camera_of_photo[i]], and lies at cam_from_world[i].

    Every camera has a photo, and cameras stand in the order in which their first photos do.

    Raises:
        ValueError: Columns of different lengths, or a camera that is missing or has no photo.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera_of_photo: Int[np.ndarray, "v"]
    cam_from_world: Rigid3
    """A batch, one pose a photo."""
    paths: tuple[Path, ...] | None = None
    """Image files; None: the photos came from no file."""
    masks: tuple[Path | None, ...] | None = None
    """Images of the photos' sizes, black where a photo is to be ignored; None: no photo has one."""

    def __post_init__(self) -> None:
        n = len(self.names)
        columns = (self.camera_of_photo, self.cam_from_world.t, self.paths, self.masks)
        if any(column is not None and len(column) != n for column in columns):
            raise ValueError(f"a table of {n} photos needs columns of that length")
        _, first = np.unique(self.camera_of_photo, return_index=True)
        used = self.camera_of_photo[np.sort(first)]
        if not np.array_equal(used, np.arange(len(self.cameras))):
            raise ValueError(
                f"photos must name cameras 0 to {len(self.cameras) - 1} by first use, got {used.tolist()}; "
                "make the table by posed_photos() or shared_cameras()"
            )

    def __len__(self) -> int:
        return len(self.names)

    def camera_of(self, photo: int) -> Camera:
        """The camera of a photo."""
        return self.cameras[int(self.camera_of_photo[photo])]

    def pose_of(self, photo: int) -> Rigid3:
        """`cam_from_world` of a photo."""
        return self.cam_from_world[photo]

    def centers(self) -> Float[np.ndarray, "v 3"]:
        """Camera positions in the world."""
        return self.cam_from_world.target_origin_in_source()

    def photos_of_cameras(self) -> list[Int[np.ndarray, "k"]]:
        """Indices of the photos of each camera."""
        return [np.flatnonzero(self.camera_of_photo == k) for k in range(len(self.cameras))]

    def select(self, photos: Sequence[int] | Int[np.ndarray, "_"]) -> PosedPhotos:
        """The table of some photos, in the given order, with the cameras that they use."""
        rows = np.array(photos, dtype=np.int64)
        return posed_photos(
            [self.names[i] for i in rows],
            self.cameras,
            self.camera_of_photo[rows],
            self.cam_from_world[rows],
            paths=None if self.paths is None else [self.paths[i] for i in rows],
            masks=None if self.masks is None else [self.masks[i] for i in rows],
        )


def posed_photos(
    names: Sequence[str],
    cameras: Sequence[Camera],
    camera_of_photo: Int[np.ndarray, "v"],
    cam_from_world: Rigid3,
    *,
    paths: Sequence[Path] | None = None,
    masks: Sequence[Path | None] | None = None,
) -> PosedPhotos:
    """The table of photos that name their cameras by index; cameras without a photo are left out."""
    used, first, position = np.unique(camera_of_photo, return_index=True, return_inverse=True)
    order = np.argsort(first)
    new_index = np.empty(len(used), dtype=np.int64)
    new_index[order] = np.arange(len(used))
    return PosedPhotos(
        tuple(names),
        tuple(cameras[int(k)] for k in used[order]),
        new_index[position.reshape(-1)],
        cam_from_world,
        None if paths is None else tuple(paths),
        None if masks is None else tuple(masks),
    )


def shared_cameras(cameras: Sequence[Camera]) -> tuple[tuple[Camera, ...], Int[np.ndarray, "v"]]:
    """Different cameras among those of all photos, in the order of first appearance, and the index of each photo's.

    Cameras are the same if model, size and all parameters are.
    """
    index: dict[tuple[str, int, int, bytes], int] = {}
    different: list[Camera] = []
    camera_of_photo = np.empty(len(cameras), dtype=np.int64)
    for i, camera in enumerate(cameras):
        key = (camera.model, camera.width, camera.height, np.asarray(camera.params, dtype=np.float64).tobytes())
        if key not in index:
            index[key] = len(different)
            different.append(camera)
        camera_of_photo[i] = index[key]
    return tuple(different), camera_of_photo


@dataclass(frozen=True, eq=False)
class DecodedPhotos:
    """Posed photos with their pixels: RGB, or RGBA with straight alpha (sRGB, 8 bits).

    Raises:
        InputError: A photo does not have the size of its camera or of its mask, or neither 3 nor 4 channels.
    """

    posed: PosedPhotos
    pixels: tuple[UInt8[np.ndarray, "_ _ _"], ...]
    keep: tuple[Bool[np.ndarray, "_ _"] | None, ...]
    """Pixels of each photo that say something of the scene; None: all."""

    def __post_init__(self) -> None:
        if not len(self.posed) == len(self.pixels) == len(self.keep):
            raise ValueError(f"{len(self.posed)} photos, pixels of {len(self.pixels)}, masks of {len(self.keep)}")
        for i, (pixels, keep) in enumerate(zip(self.pixels, self.keep, strict=True)):
            _check_size(self.posed.names[i], self.posed.camera_of(i), pixels, keep)

    def __len__(self) -> int:
        return len(self.posed)

    @property
    def have_alpha(self) -> bool:
        """Every photo has an alpha channel."""
        return all(pixels.shape[2] == 4 for pixels in self.pixels)

    def select(self, photos: Sequence[int] | Int[np.ndarray, "_"]) -> DecodedPhotos:
        """Some photos, in the given order."""
        rows = [int(i) for i in photos]
        return DecodedPhotos(
            self.posed.select(rows), tuple(self.pixels[i] for i in rows), tuple(self.keep[i] for i in rows)
        )

    def composited(self, photo: int, background: Float[np.ndarray, "3"]) -> Float[np.ndarray, "h w 3"]:
        """Colours of a photo in [0, 1] over a background, in sRGB; float32."""
        return composite_over(self.pixels[photo], background)


def _check_size(
    name: str, camera: Camera, pixels: UInt8[np.ndarray, "h w c"], keep: Bool[np.ndarray, "_ _"] | None
) -> None:
    height, width, channels = pixels.shape
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{name}: the photo has {width}x{height} pixels, its camera says {camera.width}x{camera.height}; "
            "use photos of the size that the cameras were made with"
        )
    if channels not in (3, 4):
        raise InputError(f"{name}: a photo needs 3 (RGB) or 4 (RGBA) channels, got {channels}")
    if keep is not None and keep.shape != (height, width):
        raise InputError(f"{name}: its mask has {keep.shape[1]}x{keep.shape[0]} pixels")


def composite_over(pixels: UInt8[np.ndarray, "*n c"], background: Float[np.ndarray, "3"]) -> Float[np.ndarray, "*n 3"]:
    """rgb a + background (1 - a) of RGBA pixels with straight alpha, rgb of RGB pixels; [0, 1], float32."""
    rgb = pixels[..., :3].astype(np.float32) / np.float32(255.0)
    if pixels.shape[-1] == 3:
        return rgb
    alpha = pixels[..., 3:].astype(np.float32) / np.float32(255.0)
    return rgb * alpha + background.astype(np.float32) * (1.0 - alpha)
