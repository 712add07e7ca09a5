"""What may be refined of each camera's intrinsics: steps of richer models, each earned by tracks held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.camera import Camera, plane_from_image
from fieldstone.geometry.camera_models import CAMERA_MODELS
from fieldstone.geometry.lens import corner_radius, is_invertible, sees_like_a_fisheye
from fieldstone.solve.bundle.camera_prior import CameraPrior

PRINCIPAL_POINT_SIGMA = 0.01
"""Standard deviation of the principal point about where it is taken to be, as a share of the longer side."""
ASPECT_SIGMA = 0.002
"""Of the ratio of the two focal lengths about the one given: pixels of photos are square."""
FREE_ASPECT_SIGMA = 0.2
"""The same where pixels may be of another shape."""
RADIAL_SIGMA = 0.1
"""By what share of its distance from the centre a radial term moves the corner of the photo."""
TANGENTIAL_SIGMA = 0.005
"""The same of a tangential term."""
FOCAL_SIGMA = 0.3
"""Of a focal length about its start, as a share, where nothing better is known of the start."""
FOCAL_RANGE = 2.0
"""A focal length stays within this factor of its start."""
LARGEST_DISTORTION = 1.0
"""No term moves the corner of the photo by more than this share of its distance from the centre."""
NEAR_BOUND = 0.01
"""A parameter is at a bound when it is nearer to it than this share of the interval."""
SAME_FOCAL = 1e-6
"""Focal lengths of the two axes that differ by a smaller share are one."""

CENTER = ("cx", "cy")
POWER_OF_RADIUS = {"k": 2, "k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6, "p1": 1, "p2": 1}
"""A coefficient times so many powers of the radius is a share of the radius; k4 of a fisheye lens is another."""


@dataclass(frozen=True)
class LensPrior:
    """What is known of a camera before its photos are mapped, beside what all cameras have in common."""

    focal: float = 1.0
    """Mean focal length in pixels, give or take a share `focal_sigma`."""
    focal_sigma: float = np.inf
    aspect: float = 1.0
    """Ratio fx / fy, give or take a share `aspect_sigma`."""
    aspect_sigma: float = ASPECT_SIGMA
    center: tuple[float, float] | None = None
    """Principal point in pixels; None: the centre of the photo."""

    @staticmethod
    def of(camera: Camera, focal_sigma: float = FOCAL_SIGMA) -> LensPrior:
        """That of a camera that is given, not exactly.

        Args:
            focal_sigma: How far its focal length may be off, as a share: a standard deviation.
        """
        fx, fy = camera.focal.tolist()
        cx, cy = camera.principal_point.tolist()
        return LensPrior((fx + fy) / 2.0, focal_sigma, fx / fy, center=(cx, cy))


@dataclass(frozen=True)
class CalibrationStep:
    """A camera model, the names of its parameters that are refined, and what is known of the lens."""

    model: str
    free: tuple[str, ...]
    prior: LensPrior = LensPrior()

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


def first_step(camera: Camera, focal_sigma: float = FOCAL_SIGMA) -> CalibrationStep:
    """The first of `FIRST_STEPS` whose model expresses the camera as it is; the camera is its prior.

    Args:
        focal_sigma: How far the focal length may be off, as a share: a standard deviation.
    """
    step = next(step for step in FIRST_STEPS if _expresses(step.model, camera))
    return replace(step, prior=LensPrior.of(camera, focal_sigma))


def richer_steps(step: CalibrationStep, *, principal_point: bool = True) -> list[CalibrationStep]:
    """The candidates that refine more than this one.

    Args:
        principal_point: Whether steps that move the principal point are among them.
    """
    order = [other.model for other in CANDIDATE_STEPS]
    at_least = order.index(step.model)
    out: list[CalibrationStep] = []
    for other in CANDIDATE_STEPS[at_least:]:
        richer = replace(other if principal_point else with_held_center(other), prior=step.prior)
        if not (other.model == step.model and set(richer.free) <= set(step.free)) and richer not in out:
            out.append(richer)
    return out


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
    """What is known of the refined parameters: focal lengths and distortion are bounded, pixels about square, principal
    points near the centre, distortion small.

    They are vague beside the observations of photos that determine a camera, and decide where photos do not.
    """
    out: list[CameraPrior] = []
    for c, (camera, step) in enumerate(zip(cameras, calibration, strict=True)):
        if step is None:
            continue
        names = camera.spec.param_names
        free = [k for k, name in enumerate(names) if name in step.free]
        out += [_prior_of(c, k, camera, step.prior) for k in free]
        if {0, 1} <= set(free) and camera.spec.num_focal == 2:
            sigma = step.prior.aspect_sigma * float(camera.focal[0])
            out.append(CameraPrior(c, 0, sigma=sigma, of=1, ratio=step.prior.aspect))
    return tuple(out)


def _prior_of(c: int, k: int, camera: Camera, known: LensPrior) -> CameraPrior:
    """The prior of parameter k of camera c."""
    name, value = camera.spec.param_names[k], float(camera.params[k])
    if k < camera.spec.num_focal:
        share = 2.0 * known.aspect / (1.0 + known.aspect) if name == "fx" else 2.0 / (1.0 + known.aspect)
        mean = known.focal * (1.0 if name == "f" else share)
        sigma = known.focal_sigma * mean * np.sqrt(camera.spec.num_focal)
        return CameraPrior(c, k, mean=mean, sigma=sigma, lower=value / FOCAL_RANGE, upper=value * FOCAL_RANGE)
    if name in CENTER:
        center = known.center or (camera.width / 2, camera.height / 2)
        sigma = PRINCIPAL_POINT_SIGMA * max(camera.width, camera.height)
        return CameraPrior(c, k, mean=center[name == "cy"], sigma=sigma)
    sigma, largest = _distortion_range(camera, name)
    largest = max(largest, abs(value))
    return CameraPrior(c, k, sigma=sigma, lower=-largest, upper=largest)


def _distortion_range(camera: Camera, name: str) -> tuple[float, float]:
    """Standard deviation and bound of a distortion coefficient."""
    fisheye = "FISHEYE" in camera.model
    power = 2 * int(name[1:]) if fisheye else POWER_OF_RADIUS[name]
    unit = corner_radius(camera) ** -power
    if name.startswith("p"):
        return TANGENTIAL_SIGMA * unit, LARGEST_DISTORTION * unit
    return RADIAL_SIGMA * unit, LARGEST_DISTORTION * max(unit, 1.0)


def what_is_wrong_with(camera: Camera, step: CalibrationStep) -> str:
    """Why no lens is like this camera: a parameter at a bound, pixels that no single ray reaches, a fisheye lens at
    ordinary angles; "" if there is nothing."""
    for k, name in enumerate(camera.spec.param_names):
        if name in step.free and name in POWER_OF_RADIUS:
            largest = _distortion_range(camera, name)[1]
            if abs(camera.params[k]) > (1.0 - NEAR_BOUND) * largest:
                return f"{name} is at its bound"
    if not is_invertible(camera):
        return "its distortion cannot be inverted all over the photo"
    if "FISHEYE" in camera.model and not sees_like_a_fisheye(camera):
        return "the angles are not those of a fisheye lens"
    return ""


def with_free_aspect(step: CalibrationStep) -> CalibrationStep:
    """The same step for pixels of any shape."""
    return replace(step, prior=replace(step.prior, aspect_sigma=FREE_ASPECT_SIGMA))


def with_held_center(step: CalibrationStep) -> CalibrationStep:
    """The same step with the principal point as it is given."""
    return replace(step, free=tuple(name for name in step.free if name not in CENTER))


def squareness_error(camera: Camera, step: CalibrationStep) -> float:
    """By what share the ratio of the focal lengths differs from the one given."""
    fx, fy = camera.focal.tolist()
    return abs(fx / fy / step.prior.aspect - 1.0)
