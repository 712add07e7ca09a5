"""What may be refined of each camera's intrinsics: steps of richer models, each earned by tracks held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.camera import Camera, plane_from_image
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.solve.bundle.camera_prior import CameraPrior

PRINCIPAL_POINT_SIGMA = 0.02
"""Standard deviation of the principal point about the centre of the photo, as a share of the longer side."""
FOCAL_RANGE = 2.0
"""A focal length stays within this factor of its start."""
LARGEST_COEFFICIENT = 1.0
"""Distortion coefficients beyond it describe no lens."""
SAME_FOCAL = 1e-6
"""Focal lengths of the two axes that differ by a smaller share are one."""


@dataclass(frozen=True)
class CalibrationStep:
    """A camera model and the names of its parameters that are refined."""

    model: str
    free: tuple[str, ...]

    def mask(self) -> Bool[np.ndarray, "p"]:
        """Which parameters are refined, in the order of the model."""
        return np.array([name in self.free for name in CAMERA_MODELS[self.model].param_names])


CANDIDATE_STEPS = (
    CalibrationStep("SIMPLE_PINHOLE", ("f",)),
    CalibrationStep("SIMPLE_RADIAL", ("f", "k")),
    CalibrationStep("SIMPLE_RADIAL", ("f", "cx", "cy", "k")),
    CalibrationStep("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    CalibrationStep("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    CalibrationStep("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    CalibrationStep("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
)
"""From one number to the richest models; the last one is of another kind, see `as_model`."""

FIRST_STEPS = (
    CalibrationStep("SIMPLE_RADIAL", ("f", "k")),
    CalibrationStep("RADIAL", ("f", "k1", "k2")),
    CalibrationStep("OPENCV", ("fx", "fy", "k1", "k2")),
    CalibrationStep("FULL_OPENCV", ("fx", "fy", "k1", "k2")),
    CalibrationStep("OPENCV_FISHEYE", ("fx", "fy", "k1", "k2")),
)
"""What is refined while photos are registered, by how much is given of the camera; other parameters stay as given."""

FISHEYE_RADII = 200
"""Radii at which a fisheye model is fitted to another one."""


def first_step(camera: Camera) -> CalibrationStep:
    """The first of `FIRST_STEPS` whose model expresses the camera as it is."""
    return next(step for step in FIRST_STEPS if _expresses(step.model, camera))


def richer_steps(step: CalibrationStep, *, principal_point: bool = True) -> list[CalibrationStep]:
    """The candidates that refine more than this one.

    Args:
        principal_point: Whether steps that move the principal point are among them.
    """
    order = [other.model for other in CANDIDATE_STEPS]
    at_least = order.index(step.model)
    return [
        other
        for k, other in enumerate(CANDIDATE_STEPS)
        if k >= at_least and not (other.model == step.model and set(other.free) <= set(step.free))
        if principal_point or "cx" not in other.free
    ]


def as_model(camera: Camera, model: str) -> Camera:
    """The same camera written in a richer model; terms that it lacks are 0.

    A fisheye model follows another law: it is fitted to the camera's radial distortion, up to the corners of the photo.

    Raises:
        ValueError: The target cannot express the camera.
    """
    if camera.model == model:
        return camera
    if model == "OPENCV_FISHEYE":
        return _as_fisheye(camera)
    if not _expresses(model, camera):
        raise ValueError(f"{model} cannot express {camera.model} with parameters {camera.params.tolist()}")
    known = _named_params(camera)
    names = CAMERA_MODELS[model].param_names
    if "k" in names:
        known["k"] = known.get("k1", 0.0)
    return replace(camera, model=model, params=np.array([known.get(name, 0.0) for name in names]))


def with_models(cameras: Sequence[Camera], calibration: Sequence[CalibrationStep | None]) -> tuple[Camera, ...]:
    """Every camera in the model that its step refines; None leaves it as it is."""
    steps = zip(cameras, calibration, strict=True)
    return tuple(camera if step is None else as_model(camera, step.model) for camera, step in steps)


def _named_params(camera: Camera) -> dict[str, float]:
    """Parameters by the names of all models; one focal length is three, `k` is `k1`."""
    named = dict(zip(camera.spec.param_names, camera.params.tolist(), strict=True))
    named |= {"f": float(camera.focal.mean()), "fx": float(camera.focal[0]), "fy": float(camera.focal[1])}
    if "k" in named:
        named["k1"] = named.pop("k")
    return named


def _expresses(model: str, camera: Camera) -> bool:
    """Whether a model has a place for every parameter of the camera that says something."""
    target = CAMERA_MODELS[model]
    if camera.model == model:
        return True
    if "FISHEYE" in model or "FISHEYE" in camera.model:
        return False
    if target.num_focal == 1 and abs(camera.focal[0] / camera.focal[1] - 1.0) > SAME_FOCAL:
        return False
    room = {"k1" if name == "k" else name for name in target.coefficient_names}
    named = _named_params(camera)
    needed = {"k1" if name == "k" else name for name in camera.spec.coefficient_names}
    return all(named[name] == 0.0 for name in needed - room)


def _as_fisheye(camera: Camera) -> Camera:
    """The fisheye camera whose radii differ least from the camera's along the diagonal of the photo."""
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], dtype=float)
    farthest = corners[np.argmax(np.linalg.norm(corners - camera.principal_point, axis=1))]
    share = np.linspace(0.0, 1.0, FISHEYE_RADII + 1)[1:, None]
    pixels = camera.principal_point + share * (farthest - camera.principal_point)
    theta = np.arctan(np.linalg.norm(plane_from_image(camera, pixels), axis=1))
    radius = np.linalg.norm((pixels - camera.principal_point) / camera.focal, axis=1)
    seen = np.isfinite(theta)
    # radius = s (theta + k1 theta^3 + k2 theta^5 + ...) is linear in s, s k1, s k2, ...; s scales the focal lengths.
    powers = theta[seen, None] ** np.array([1, 3, 5, 7, 9])
    s, *coefficients = np.linalg.lstsq(powers, radius[seen])[0]
    params = np.array([*(s * camera.focal), *camera.principal_point, *(np.array(coefficients) / s)])
    return replace(camera, model="OPENCV_FISHEYE", params=params)


def priors(cameras: Sequence[Camera], calibration: Sequence[CalibrationStep | None]) -> tuple[CameraPrior, ...]:
    """What is known of the refined parameters: focal lengths and coefficients are bounded, principal points near the
    centre."""
    out = []
    for c, (camera, step) in enumerate(zip(cameras, calibration, strict=True)):
        if step is None:
            continue
        center = {"cx": camera.width / 2, "cy": camera.height / 2}
        sigma = PRINCIPAL_POINT_SIGMA * max(camera.width, camera.height)
        for k, name in enumerate(camera.spec.param_names):
            value = float(camera.params[k])
            if name not in step.free:
                continue
            if k < camera.spec.num_focal:
                out.append(CameraPrior(c, k, lower=value / FOCAL_RANGE, upper=value * FOCAL_RANGE))
            elif name in center:
                out.append(CameraPrior(c, k, mean=center[name], sigma=sigma))
            else:
                largest = max(LARGEST_COEFFICIENT, abs(value))
                out.append(CameraPrior(c, k, lower=-largest, upper=largest))
    return tuple(out)
