"""What a user may choose, one frozen dataclass a verb: the command line and the Python API take the same.

A message about an option names it in backticks, `like_this`; the command line spells it `--like-this`. Where a value is
written differently on a command line (10m, or numbers with commas), the field says so.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from fieldstone.errors import InputError

FieldKind = Literal["fast", "tiny", "nerf"]
Quality = Literal["draft", "normal", "high"]
FilmFormat = Literal["mp4", "gif", "png"]
Shown = Literal["color", "depth", "normals", "opacity", "confidence"]
MeshFormat = Literal["ply", "obj", "glb"]

QUALITY_S = {"draft": 20.0, "normal": 60.0, "high": 300.0}
"""Seconds of training that a quality stands for."""
TIME_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def seconds(text: str) -> float:
    """A time such as 300s, 10m, 1.5h, or a plain number of seconds.

    Raises:
        InputError: It is none, or not positive.
    """
    number, unit = (text[:-1], TIME_UNITS[text[-1]]) if text[-1:] in TIME_UNITS else (text, 1.0)
    try:
        found = float(number) * unit
    except ValueError:
        found = -1.0
    if not 0 < found < math.inf:
        raise InputError(f"`budget_s` {text}: give a positive time such as 300s, 10m or 2h")
    return found


def photo_names(text: str) -> tuple[str, ...]:
    """The names in a list with commas; none of them for the word none."""
    return () if text == "none" else tuple(name.strip() for name in text.split(",") if name.strip())


def camera_parameters(text: str) -> tuple[float, ...]:
    """Numbers with commas.

    Raises:
        InputError: Other words than numbers.
    """
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"`intrinsics` {text}: give numbers with commas, such as 1400,1400,800,600") from None


def _written(metavar: str, read: Callable[[str], Any]) -> Any:
    """How tyro reads an option that is written as one word."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )


TimeOption = Annotated[float | int | None, tyro.conf.arg(name="budget"), _written("30s|10m|2h", seconds)]
NamesOption = Annotated[tuple[str, ...] | None, _written("A,B|none", photo_names)]
NumbersOption = Annotated[tuple[float, ...] | None, _written("FX,FY,CX,CY", camera_parameters)]


def at_least(least: int, **values: int | None) -> None:
    """Options that must reach a number.

    Raises:
        InputError: One of them does not.
    """
    for name, value in values.items():
        if value is not None and value < least:
            raise InputError(f"`{name}` must be at least {least}, got {value}")


def positive(**values: float | int | None) -> None:
    """Options that must be positive.

    Raises:
        InputError: One of them is not.
    """
    for name, value in values.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"`{name}` must be positive, got {value:g}")


def workers(threads: int) -> int:
    """Threads that a number of them stands for: 0 takes one for each core."""
    return threads or os.cpu_count() or 1


@dataclass(frozen=True)
class TrainOptions:
    """How posed photos become a field.

    Raises:
        InputError: A value that nothing could be trained with, or one that belongs to another kind of field.
    """

    field: FieldKind = "fast"
    """fast needs seconds to minutes and no torch; tiny is the small network of the course at 100x100, nerf the original
    NeRF at 400x400."""
    budget_s: TimeOption = None
    """Time for reading and training: 60s, 10m, 2h. A run that goes on after a stop follows the plan that it began with;
    for the classical networks, the time is that of all runs in this folder."""
    quality: Quality = "normal"
    """The budget, where none is given: draft 20s, normal 60s, high 5m."""
    memory: float = 4.0
    """GiB that grids and rays may take (fast only)."""
    steps: int | None = None
    """Stop after so many steps in all, if the budget lasts."""
    plan: Path | None = None
    """The plan.json that an earlier run of the fast field left: the same plan gives the same bytes."""
    alpha: bool = True
    """Use the transparency of photos; without it they are taken as they look on the background (fast only)."""
    photos: Path | None = None
    """Folder with the photos of a reconstruction, if they are not where they were."""
    masks: Path | None = None
    """Folder with a mask for each photo, named a.jpg.png, a.jpg or a.png for a.jpg. Nothing is learned where they are
    black, nor measured; by default those of the reconstruction (fast only)."""
    size: int | None = None
    """Photos are reduced to this length of their longer side, in pixels; by default to what the memory holds (fast
    only)."""
    refine_poses: bool = False
    """Move the training photos a little, so that the field fits them; known points of a reconstruction hold them (fast
    only)."""
    hold_out: NamesOption = None
    """Photos to measure with, by name, with commas between: a.jpg,b.jpg; none learns from all of them. By default the
    test views of the source, or every 8th photo."""
    device: str = "cpu"
    """cpu, cuda, mps; others than cpu need torch. The fast field was never tried on a GPU, and learns there the same
    field to rounding, not to the same bytes; it is rendered on the CPU."""
    threads: int = 0
    """0 takes all cores. The result is the same for any number."""
    seed: int = 0
    """Every random number of the run follows from it."""

    def __post_init__(self) -> None:
        positive(budget_s=self.budget_s, memory=self.memory)
        at_least(1, steps=self.steps, size=self.size)
        at_least(0, threads=self.threads, seed=self.seed)
        if self.field == "fast":
            return
        for name in ("plan", "alpha", "masks", "size", "refine_poses", "memory"):
            if getattr(self, name) != type(self).__dataclass_fields__[name].default:
                raise InputError(f"`{name}` belongs to the fast field; leave it out for `field` {self.field}")

    @property
    def seconds(self) -> float:
        """The budget, as given or as the quality says."""
        return QUALITY_S[self.quality] if self.budget_s is None else float(self.budget_s)


@dataclass(frozen=True)
class RenderOptions:
    """A film of a field.

    Raises:
        InputError: A number below 1.
    """

    path: str = "orbit"
    """orbit goes around what the photos look at, spiral loops near their middle, through goes from one to the next;
    dataset takes the poses of the training photos, FILE.json those of a file: frames as in transforms.json, or a
    camera_path of nerfstudio in the world of the photos."""
    format: FilmFormat = "mp4"
    """mp4 and gif give one file, png a folder of images."""
    show: Shown = "color"
    """color; depth, near is bright; normals as colours, x to the right, y up, z to the camera; opacity; confidence, how
    many photos determine what is seen."""
    frames: int | None = None
    """Number of images; by default 120, or one for each pose of dataset and files."""
    fps: int = 30
    """Images per second."""
    size: int | None = None
    """Longer side in pixels; by default as trained."""
    device: str = "cpu"
    """cpu, cuda, mps, for the classical networks; the fast field is rendered on the CPU."""
    threads: int = 0
    """0 takes all cores."""

    def __post_init__(self) -> None:
        at_least(1, frames=self.frames, fps=self.fps, size=self.size)
        at_least(0, threads=self.threads)


@dataclass(frozen=True)
class SurfaceOptions:
    """Where the surface of a field lies, for meshes and splats.

    Raises:
        InputError: Values that make no surface.
    """

    cells: int | None = None
    """Grid cells along the longest side; by default as the field, at most 320."""
    level: float = 0.5
    """Share of the light that matter must stop to count as solid."""
    threads: int = 0
    """0 takes all cores."""

    def __post_init__(self) -> None:
        if not 0 < self.level < 1:
            raise InputError(f"`level` must lie between 0 and 1, got {self.level:g}")
        at_least(2, cells=self.cells)
        at_least(0, threads=self.threads)


@dataclass(frozen=True)
class DemoOptions:
    """The whole road on photos that the package makes itself.

    Raises:
        InputError: A value that nothing could be trained with.
    """

    budget_s: TimeOption = 60.0
    """Time for training the field: 60s, 5m."""
    threads: int = 0
    """0 takes all cores. The result of the reconstruction is the same for any number."""
    seed: int = 0
    """Every random number of the run follows from it."""

    def __post_init__(self) -> None:
        positive(budget_s=self.budget_s)
        at_least(0, threads=self.threads, seed=self.seed)
