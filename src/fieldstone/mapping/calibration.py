"""What may be refined of each camera's intrinsics: steps of richer models, each earned by tracks held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.camera import CAMERA_MODELS, Camera
from fieldstone.solve.camera_prior import CameraPrior

PRINCIPAL_POINT_SIGMA = 0.02
"""Standard deviation of the principal point about the centre of the photo, as a share of the longer side."""
FOCAL_RANGE = 2.0
"""A focal length stays within this factor of its start."""
LARGEST_COEFFICIENT = 1.0
"""Distortion coefficients beyond it describe no lens."""


@dataclass(frozen=True)
class CalibrationStep:
    """A camera model and the names of its parameters that are refined."""

    model: str
    free: tuple[str, ...]

    def mask(self) -> Bool[np.ndarray, "p"]:
        """Which parameters are refined, in the order of the model."""
        return np.array([name in self.free for name in CAMERA_MODELS[self.model].param_names])


LADDER = (
    CalibrationStep("SIMPLE_PINHOLE", ("f",)),
    CalibrationStep("SIMPLE_RADIAL", ("f", "k")),
    CalibrationStep("SIMPLE_RADIAL", ("f", "cx", "cy", "k")),
    CalibrationStep("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    CalibrationStep("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    CalibrationStep("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
)
"""From one number to the richest model."""


def as_model(camera: Camera, model: str) -> Camera:
    """The same camera written in a richer model; terms that it lacks are 0.

    Raises:
        ValueError: The target cannot express the camera's distortion.
    """
    if camera.model == model:
        return camera
    source, target = camera.spec, CAMERA_MODELS[model]
    values = {"cx": camera.principal_point[0], "cy": camera.principal_point[1]}
    values |= {"f": float(camera.focal.mean()), "fx": camera.focal[0], "fy": camera.focal[1]}
    coefficients = dict(zip(source.coefficient_names, camera.coefficients.tolist(), strict=True))
    if "k" in coefficients:
        coefficients["k1"] = coefficients.pop("k")
    if "k" in target.coefficient_names:
        coefficients["k"] = coefficients.pop("k1", 0.0)
    lost = [name for name, value in coefficients.items() if value != 0.0 and name not in target.coefficient_names]
    if lost or "FISHEYE" in model or "FISHEYE" in camera.model:
        raise ValueError(f"{model} cannot express {camera.model} with {', '.join(lost) or 'fisheye distortion'}")
    values |= coefficients
    return replace(camera, model=model, params=np.array([values.get(name, 0.0) for name in target.param_names]))


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
