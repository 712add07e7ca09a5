"""Bundle Adjustment in the Large: the text format of its bundle problems, read and written.

A BAL camera looks along -z with the image's y axis up, and its pixels are measured from the principal point. Ours
looks along +z with y down, so poses are multiplied by diag(1, -1, -1) from the left and the image's y is negated.

Source:
    `agarwal2010`; format: https://grail.cs.washington.edu/projects/bal/.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fieldstone.errors import InputError
from fieldstone.geometry import rotation
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.opengl import CV_FROM_GL
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.io.files.others import finite_words, is_finite_word
from fieldstone.solve.bundle.problem import BundleProblem

CAM_FROM_BAL_CAM = CV_FROM_GL
IMAGE_FROM_BAL_IMAGE = np.array([1.0, -1.0])
PARAMS_PER_CAMERA = 9
MAX_ANGLE = 1e3
"""Radians; solvers leave rotation vectors of a few turns, more is damage."""
MAX_PIXEL = 1e6


class Line(NamedTuple):
    """One line of the file that is not blank."""

    number: int
    text: str


def read_bal(path: Path) -> BundleProblem:
    """The problem of a BAL file: RADIAL cameras with principal point (0, 0) held, everything else free.

    Every view has its own camera, with focal length and both distortion coefficients to refine. The format does not
    record the size of the images; it is set to hold every observation when measured from the centre.

    Raises:
        InputError: The file cannot be read, is cut off, or holds a number that cannot be right.
    """
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a BAL file ({error})") from error
    lines = [Line(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    num_views, num_points, num_observations = _read_header(path, lines)
    observation_lines = lines[1 : 1 + num_observations]
    rows = _read_observations(path, observation_lines)
    for kind, index, count in (("camera", rows[:, 0], num_views), ("point", rows[:, 1], num_points)):
        outside = np.flatnonzero((index < 0) | (index >= count))
        if len(outside):
            k = int(outside[0])
            raise InputError(
                f"{path}, line {observation_lines[k].number}: {kind} {index[k]:.0f} does not exist, there are {count}"
            )
    values = _read_values(path, lines[1 + num_observations :])
    expected = PARAMS_PER_CAMERA * num_views + 3 * num_points
    if len(values) != expected:
        raise InputError(
            f"{path}: {num_views} cameras and {num_points} points need {expected} numbers after the observations, "
            f"found {len(values)}: the file is {'cut off' if len(values) < expected else 'longer than its header says'}"
        )
    camera_rows = values[: PARAMS_PER_CAMERA * num_views].reshape(num_views, PARAMS_PER_CAMERA)
    bad = np.flatnonzero((camera_rows[:, 6] <= 0) | np.any(np.abs(camera_rows[:, :3]) > MAX_ANGLE, axis=1))
    if len(bad):
        raise InputError(
            f"{path}: camera {bad[0]} has rotation vector {camera_rows[bad[0], :3].tolist()} and focal length "
            f"{camera_rows[bad[0], 6]}: angles are radians and a focal length is positive, the file is damaged"
        )
    far = np.flatnonzero(np.any(np.abs(rows[:, 2:]) > MAX_PIXEL, axis=1))
    if len(far):
        number, text = observation_lines[int(far[0])]
        raise InputError(f"{path}, line {number}: no photo is {MAX_PIXEL:.0f} pixels wide: {text[:60]!r} is damaged")
    pixels = rows[:, 2:] * IMAGE_FROM_BAL_IMAGE
    width, height = np.ceil(2.0 * np.abs(pixels).max(axis=0, initial=0.5)).astype(int)
    cameras = tuple(
        Camera("RADIAL", int(width), int(height), np.array([f, 0.0, 0.0, k1, k2])) for f, k1, k2 in camera_rows[:, 6:]
    )
    return BundleProblem(
        cameras=cameras,
        camera_of_view=np.arange(num_views),
        cam_from_world=Rigid3(
            CAM_FROM_BAL_CAM @ rotation.exp(camera_rows[:, :3]), camera_rows[:, 3:6] @ CAM_FROM_BAL_CAM
        ),
        points=values[PARAMS_PER_CAMERA * num_views :].reshape(num_points, 3),
        view=rows[:, 0].astype(np.int64),
        point=rows[:, 1].astype(np.int64),
        pixels=pixels,
        fixed_views=np.zeros(num_views, dtype=bool),
        fixed_points=np.zeros(num_points, dtype=bool),
        refine=(np.array([True, False, False, True, True]),) * num_views,
    )


def write_bal(problem: BundleProblem, path: Path) -> None:
    """Write a problem as BAL text, with every digit; which parameters are held is not recorded.

    Raises:
        InputError: A camera has no place in the format (only SIMPLE_PINHOLE, SIMPLE_RADIAL and RADIAL have).
    """
    rows = []
    for i, c in enumerate(problem.camera_of_view):
        camera = problem.cameras[c]
        if camera.model not in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
            raise InputError(
                f"BAL has one focal length and two radial coefficients: camera {c} is {camera.model}; "
                "undistort the photos or refine with the RADIAL model first"
            )
        k = np.concatenate([camera.coefficients, np.zeros(2)])[:2]
        bal_cam_from_world_R = CAM_FROM_BAL_CAM @ problem.cam_from_world.R[i]
        omega = rotation.log(bal_cam_from_world_R)
        rows += [*omega, *(CAM_FROM_BAL_CAM @ problem.cam_from_world.t[i]), camera.params[0], *k]
    centres = np.array([problem.cameras[c].principal_point for c in problem.camera_of_view]).reshape(-1, 2)
    bal_pixels = (problem.pixels - centres[problem.view]) * IMAGE_FROM_BAL_IMAGE
    with path.open("w", encoding="ascii") as file:
        file.write(f"{problem.num_views} {len(problem.points)} {len(problem.view)}\n")
        for i, j, (x, y) in zip(problem.view, problem.point, bal_pixels.tolist(), strict=True):
            file.write(f"{i} {j} {x!r} {y!r}\n")
        for value in [*rows, *problem.points.ravel()]:
            file.write(f"{float(value)!r}\n")


def _read_header(path: Path, lines: list[Line]) -> tuple[int, int, int]:
    """Numbers of cameras, points and observations."""
    header = lines[0].text if lines else ""
    fields = header.split()
    if len(fields) != 3 or not all(field.isdecimal() for field in fields):
        raise InputError(
            f"{path}, line 1: a BAL file starts with the numbers of cameras, points and observations, "
            f"got {header[:60]!r}"
        )
    num_views, num_points, num_observations = (int(field) for field in fields)
    if len(lines) < 1 + num_observations:
        raise InputError(
            f"{path}: the header says {num_observations} observations, the file ends after {len(lines) - 1}: "
            "it is cut off, fetch it again"
        )
    return num_views, num_points, num_observations


def _read_observations(path: Path, lines: list[Line]) -> Float[np.ndarray, "o 4"]:
    """Camera index, point index and BAL pixels of every observation."""
    fields = [line.text.split() for line in lines]
    try:
        rows = np.array(fields, dtype=np.float64).reshape(-1, 4)
    except ValueError:  # a line of another length, or a word
        rows = np.full((1, 4), np.nan)
    if len(rows) != len(lines) or not np.all(np.isfinite(rows)) or np.any(rows[:, :2] != np.floor(rows[:, :2])):
        number, text = next((line for line in lines if not _is_observation(line.text)), lines[0])
        raise InputError(f"{path}, line {number}: expected 'camera point x y', got {text[:60]!r}: the file is damaged")
    return rows


def _is_observation(text: str) -> bool:
    """Two indices and two finite numbers."""
    fields = text.split()
    return len(fields) == 4 and all(f.isdecimal() for f in fields[:2]) and all(is_finite_word(f) for f in fields[2:])


def _read_values(path: Path, lines: list[Line]) -> Float[np.ndarray, "n"]:
    """Camera and point parameters, any number of them per line."""
    return finite_words(path, [line.text.split() for line in lines], [line.number for line in lines])
