"""Camera models: projection with analytic Jacobians, and back to bearings.

Pixels: x right, y down, the corner of the image is (0, 0) and the centre of the first pixel (0.5, 0.5).
Camera frame: x right, y down, z forward. See docs/conventions.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fieldstone.geometry.camera_models import CAMERA_MODELS, CameraModel

MAX_NEWTON_STEPS = 50


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera: model name, image size in pixels, parameters in the order of the model.

    Raises:
        ValueError: Unknown model, wrong number of parameters, or a focal length that is not positive.
    """

    model: str
    width: int
    height: int
    params: Float[np.ndarray, "p"]

    def __post_init__(self) -> None:
        if self.model not in CAMERA_MODELS:
            raise ValueError(f"unknown camera model {self.model!r}; known: {', '.join(CAMERA_MODELS)}")
        spec = CAMERA_MODELS[self.model]
        if len(self.params) != spec.num_params:
            raise ValueError(
                f"{self.model} has {spec.num_params} parameters ({', '.join(spec.param_names)}), got {len(self.params)}"
            )
        if not np.all(np.isfinite(self.params)):
            raise ValueError(f"camera parameters must be finite, got {self.params.tolist()}")
        if not np.all(self.params[: spec.num_focal] > 0):
            raise ValueError(f"focal length must be positive, got {self.params[: spec.num_focal].tolist()}")

    @property
    def spec(self) -> CameraModel:
        """How `params` is read."""
        return CAMERA_MODELS[self.model]

    @property
    def focal(self) -> Float[np.ndarray, "2"]:
        """(fx, fy) in pixels."""
        return np.array([self.params[0], self.params[self.spec.num_focal - 1]])

    @property
    def principal_point(self) -> Float[np.ndarray, "2"]:
        """(cx, cy) in pixels, corner convention."""
        return self.params[self.spec.num_focal : self.spec.num_focal + 2]

    @property
    def coefficients(self) -> Float[np.ndarray, "k"]:
        """Distortion coefficients."""
        return self.params[self.spec.num_focal + 2 :]

    def calibration_matrix(self) -> Float[np.ndarray, "3 3"]:
        """K of the ideal (undistorted) camera."""
        fx, fy = self.focal
        cx, cy = self.principal_point
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pinhole(width: int, height: int, K: Float[np.ndarray, "3 3"]) -> Camera:
    """PINHOLE camera from a calibration matrix without skew, principal point in the corner convention."""
    return Camera("PINHOLE", width, height, np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dtype=np.float64))


def image_from_cam(camera: Camera, points_in_cam: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Pixels of points; nan for points with z <= 0 (behind the camera)."""
    return image_from_plane(camera, plane_from_cam(points_in_cam))


def plane_from_cam(points_in_cam: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Ideal coordinates (x/z, y/z) on the plane z = 1; nan for z <= 0."""
    z = points_in_cam[:, 2:]
    return points_in_cam[:, :2] / np.where(z > 0, z, np.nan)


def image_from_plane(camera: Camera, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Pixels of ideal coordinates on the plane z = 1."""
    distorted, _, _ = camera.spec.distort(uv, camera.coefficients)
    return distorted * camera.focal + camera.principal_point


def image_from_cam_jacobian(
    camera: Camera, points_in_cam: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 p"]]:
    """Pixels, their derivative by the points in the camera frame, and by the camera's parameters.

    nan in every part for points with z <= 0.
    """
    spec = camera.spec
    n = len(points_in_cam)
    uv = plane_from_cam(points_in_cam)
    distorted, D_uv, D_k = spec.distort(uv, camera.coefficients)
    z = np.where(points_in_cam[:, 2] > 0, points_in_cam[:, 2], np.nan)

    uv_by_point = np.zeros((n, 2, 3))
    uv_by_point[:, 0, 0] = uv_by_point[:, 1, 1] = 1.0 / z
    uv_by_point[:, :, 2] = -uv / z[:, None]
    J_point = camera.focal[:, None] * (D_uv @ uv_by_point)

    J_params = np.zeros((n, 2, spec.num_params))
    if spec.num_focal == 1:
        J_params[:, :, 0] = distorted
    else:
        J_params[:, 0, 0] = distorted[:, 0]
        J_params[:, 1, 1] = distorted[:, 1]
    J_params[:, 0, spec.num_focal] = J_params[:, 1, spec.num_focal + 1] = 1.0
    J_params[:, :, spec.num_focal + 2 :] = camera.focal[:, None] * D_k
    return distorted * camera.focal + camera.principal_point, J_point, J_params


def plane_from_image(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Ideal coordinates on the plane z = 1 of pixels: Newton's method on the distortion.

    nan where the distortion has no inverse near the pixel (outside the lens model's range).
    """
    target = (pixels - camera.principal_point) / camera.focal
    if not camera.spec.coefficient_names or not len(pixels):
        return target
    uv = target.copy()
    for _ in range(MAX_NEWTON_STEPS):
        distorted, J_uv, _ = camera.spec.distort(uv, camera.coefficients)
        residual = distorted - target
        det = J_uv[:, 0, 0] * J_uv[:, 1, 1] - J_uv[:, 0, 1] * J_uv[:, 1, 0]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step_u = (J_uv[:, 1, 1] * residual[:, 0] - J_uv[:, 0, 1] * residual[:, 1]) / det
            step_v = (J_uv[:, 0, 0] * residual[:, 1] - J_uv[:, 1, 0] * residual[:, 0]) / det
        step = np.stack([step_u, step_v], axis=1)
        # A step longer than the field of view has left the basin of convergence: shorten it.
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
        uv = uv - np.nan_to_num(step)
        if np.nanmax(length, initial=0.0) < 1e-14:
            break
    distorted, J_uv, _ = camera.spec.distort(uv, camera.coefficients)
    inverse_exists = J_uv[:, 0, 0] * J_uv[:, 1, 1] > J_uv[:, 0, 1] * J_uv[:, 1, 0]
    converged = np.linalg.norm(distorted - target, axis=1) < 1e-9
    return np.where((converged & inverse_exists)[:, None], uv, np.nan)


def bearings_from_image(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Unit viewing directions in the camera frame; nan where the distortion has no inverse."""
    uv = plane_from_image(camera, pixels)
    bearings = np.concatenate([uv, np.ones((len(uv), 1))], axis=1)
    return bearings / np.linalg.norm(bearings, axis=1, keepdims=True)


def rescale(camera: Camera, width: int, height: int) -> Camera:
    """The camera of the same photo at another size: each axis scales by its own factor (corner convention)."""
    scale = np.array([width / camera.width, height / camera.height])
    spec = camera.spec
    params = camera.params.copy()
    params[: spec.num_focal] *= scale if spec.num_focal == 2 else scale.mean()
    params[spec.num_focal : spec.num_focal + 2] *= scale
    return Camera(camera.model, width, height, params)


def turned(camera: Camera, turn: Int[np.ndarray, "2 2"]) -> Camera:
    """The camera of the same photo turned by quarters or mirrored: directions (right, down) become `turn` of them.

    Args:
        turn: Orthogonal, of 0, 1 and -1.
    """
    spec, size = camera.spec, np.array([camera.width, camera.height])
    new_size = np.abs(turn) @ size
    params = camera.params.copy()
    if spec.num_focal == 2:
        params[:2] = np.abs(turn) @ camera.focal
    params[spec.num_focal : spec.num_focal + 2] = turn @ (camera.principal_point - size / 2) + new_size / 2
    if "p1" in spec.coefficient_names:
        # Tangential distortion is r^2 q + 2 (q . uv) uv with q = (p2, p1), a direction like any other.
        at = [spec.param_names.index(name) for name in ("p2", "p1")]
        params[at] = turn @ params[at]
    return Camera(camera.model, int(new_size[0]), int(new_size[1]), params)
