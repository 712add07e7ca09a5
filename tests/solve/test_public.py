"""What `fieldstone.solve` offers: every public name once, through the package, with an oracle."""

import inspect
import subprocess
import sys

import numpy as np
import pytest

import fieldstone.geometry as g
import fieldstone.solve as s

CAMERA = g.Camera("PINHOLE", 800, 600, np.array([700.0, 690.0, 400.0, 300.0]))
POSES = g.Rigid3.stack(
    [
        g.look_at(np.array([x, -0.3 * x * x, -6.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
        for x in (-1.5, 0.2, 1.0, 2.0)
    ]
)
POINTS = np.random.default_rng(0).uniform(-1, 1, size=(60, 3))
PIXELS = np.stack([g.image_from_cam(CAMERA, pose.apply(POINTS)) for pose in POSES])
UV = np.stack([g.plane_from_image(CAMERA, pixels) for pixels in PIXELS])
RELATIVE = POSES[1] @ POSES[0].inverse()
E_TRUE = g.essential_from_pose(RELATIVE)
VIEW, POINT = (index.ravel() for index in np.indices((4, 60)))


def error_up_to_scale(found: np.ndarray, truth: np.ndarray) -> float:
    a, b = found / np.linalg.norm(found), truth / np.linalg.norm(truth)
    return float(min(np.linalg.norm(a - b), np.linalg.norm(a + b)))


def pose_error(found: g.Rigid3, truth: g.Rigid3) -> float:
    return max(float(g.rotation.angle_between(found.R, truth.R)), float(np.linalg.norm(found.t - truth.t)))


def bundle(points: np.ndarray = POINTS, noise_px: float = 0.0) -> s.BundleProblem:
    noise = noise_px * np.random.default_rng(1).normal(size=(240, 2))
    return s.BundleProblem(
        cameras=(CAMERA,),
        camera_of_view=np.zeros(4, dtype=np.int64),
        cam_from_world=POSES,
        points=points,
        view=VIEW,
        point=POINT,
        pixels=PIXELS.reshape(-1, 2) + noise,
        fixed_views=np.arange(4) < 2,
        fixed_points=np.zeros(60, dtype=bool),
        refine=(np.zeros(4, dtype=bool),),
    )


def moved_points(size: float = 0.02) -> np.ndarray:
    return POINTS + size * np.random.default_rng(2).normal(size=POINTS.shape)


def five_point() -> float:
    bearings = [g.homogeneous(uv[:5]) for uv in UV[:2]]
    return min(error_up_to_scale(E, E_TRUE) for E in s.five_point(*bearings))


def seven_point() -> float:
    x = [g.homogeneous(uv[:7]) for uv in UV[:2]]
    return min(error_up_to_scale(F, E_TRUE) for F in s.seven_point(*x))


def fundamental_eight_point() -> float:
    return error_up_to_scale(s.fundamental_eight_point(UV[0], UV[1]), E_TRUE)


def p3p() -> float:
    return min(pose_error(pose, POSES[0]) for pose in s.p3p(g.homogeneous(UV[0, :3]), POINTS[:3]))


def pnp_linear() -> float:
    R_t = s.pnp_linear(UV[0], POINTS)
    return pose_error(g.Rigid3(R_t[:, :3], R_t[:, 3]), POSES[0])


def pnp_nonlinear() -> float:
    start = POSES[0].retract(np.full(6, 0.01))
    return pose_error(s.pnp_nonlinear(CAMERA, start, PIXELS[0], POINTS, loss=s.huber(1.0)), POSES[0])


def homography_four_point() -> float:
    H = np.array([[1.1, 0.1, 0.02], [-0.05, 0.95, 0.1], [0.03, 0.02, 1.0]])
    x1 = g.homogeneous(np.array([[-0.5, -0.5], [0.5, -0.4], [0.4, 0.6], [-0.3, 0.4]]))
    x2 = x1 @ H.T
    found = s.homography_four_point(x1, x2 / x2[:, 2:])
    assert found is not None
    return error_up_to_scale(found, H)


def estimate_absolute_pose() -> float:
    pixels = PIXELS[0].copy()
    pixels[:10] += 80.0
    found = s.estimate_absolute_pose(CAMERA, pixels, POINTS, s.RansacOptions(), np.random.default_rng(0))
    assert isinstance(found, s.AbsolutePose)
    assert found.inliers.tolist() == [False] * 10 + [True] * 50
    return pose_error(found.cam_from_world, POSES[0])


def estimate_two_view() -> float:
    options = s.TwoViewOptions(s.RansacOptions(max_error_px=1.0, min_trials=30))
    found = s.estimate_two_view(CAMERA, CAMERA, PIXELS[0], PIXELS[1], options, np.random.default_rng(0))
    assert found.kind == "calibrated"
    return error_up_to_scale(found.matrix, E_TRUE)


def triangulate_robust() -> float:
    order = np.argsort(POINT, kind="stable")
    starts = np.arange(0, 241, 4)
    focal = np.full(4, float(CAMERA.focal.mean()))
    uv = UV.reshape(-1, 2)[order]
    found, inliers = s.triangulate_robust(POSES, focal, VIEW[order], uv, starts, max_error_px=1.0, min_angle=0.02)
    assert inliers.all()
    return float(np.abs(found - POINTS).max())


def triangulate_nonlinear() -> float:
    cameras, of_view = [CAMERA], np.zeros(4, dtype=np.int64)
    pixels = PIXELS.reshape(-1, 2)
    found = s.triangulate_nonlinear(
        cameras, of_view, POSES, VIEW, POINT, pixels, moved_points(), loss=s.trivial(), max_iterations=100
    )
    return float(np.abs(found - POINTS).max())


def bundle_adjust() -> float:
    result = s.bundle_adjust(bundle(moved_points()), s.BundleOptions(relative_tolerance=1e-12))
    assert isinstance(result, s.BundleResult)
    return float(np.abs(result.problem.points - POINTS).max())


def bundle_adjust_scipy() -> float:
    result = s.bundle_adjust_scipy(bundle(moved_points()), loss=s.cauchy(1.0), relative_tolerance=1e-14)
    return float(np.abs(result.problem.points - POINTS).max())


def reprojection_residuals() -> float:
    problem = bundle(noise_px=1.0)
    return float(np.abs(s.reprojection_residuals(problem) - (PIXELS.reshape(-1, 2) - problem.pixels)).max())


def camera_prior() -> float:
    """A prior on a focal length that is not refined says nothing."""
    options = s.BundleOptions(camera_priors=(s.CameraPrior(0, 0, mean=1.0, sigma=1.0),), relative_tolerance=1e-12)
    return float(np.abs(s.bundle_adjust(bundle(moved_points()), options).problem.points - POINTS).max())


def bundle_covariance() -> float:
    """A point with held views: the inverse of its own normal equations."""
    problem = bundle()
    held = s.BundleProblem(**{**vars(problem), "fixed_views": np.ones(4, dtype=bool)})
    found = s.bundle_covariance(held, sigma_px=0.5)
    assert isinstance(found, s.BundleCovariance)
    J = np.concatenate([g.image_from_world_jacobian(CAMERA, pose, POINTS[:1]).by_point[0] for pose in POSES])
    expected = 0.25 * np.linalg.inv(J.T @ J)
    return float(np.abs(found.of_points[0] / expected - 1).max())


def average_rotations() -> float:
    pairs = np.array([[i, j] for i in range(4) for j in range(i)])
    relative = POSES.R[pairs[:, 1]] @ np.swapaxes(POSES.R[pairs[:, 0]], 1, 2)
    found = s.average_rotations(pairs, relative, np.ones(len(pairs)))
    return float(g.rotation.angle_between(found, POSES.R @ POSES.R[0].T).max())


def position_views_and_points() -> float:
    centers = POSES.target_origin_in_source()
    rays = POINTS[POINT] - centers[VIEW]
    found, _ = s.position_views_and_points(VIEW, POINT, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    return float(np.abs(g.fit_sim3(found, centers).apply(found) - centers).max())


def losses() -> float:
    """All equal least squares near 0, and grow ever more slowly in the order trivial, Huber or soft L1, Cauchy."""
    near, far = np.array([1e-12]), np.array([1e4])
    kinds: tuple[s.RobustLoss, ...] = (s.trivial(), s.huber(1.0), s.soft_l1(1.0), s.cauchy(1.0))
    growth = [float(loss(far)[0][0]) for loss in kinds]
    assert growth[0] > max(growth[1:3]) > min(growth[1:3]) > growth[3]
    return max(abs(float(loss(near)[0][0]) / 1e-12 - 1.0) for loss in kinds)


CASES = (
    average_rotations, bundle_adjust, bundle_adjust_scipy, bundle_covariance, camera_prior, estimate_absolute_pose,
    estimate_two_view, five_point, fundamental_eight_point, homography_four_point, losses, p3p, pnp_linear,
    pnp_nonlinear, position_views_and_points, reprojection_residuals, seven_point, triangulate_nonlinear,
    triangulate_robust,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_public_function_meets_its_oracle(case):
    assert case() < 1e-5


def test_every_public_name_is_tried_here_and_documented():
    source = inspect.getsource(sys.modules[__name__])
    for name in dir(s):
        assert f"s.{name}" in source, name
        public = getattr(s, name)
        if inspect.isroutine(public) or inspect.isclass(public):
            assert public.__doc__, name
            assert not public.__doc__.startswith(f"{name}("), f"{name} has no docstring but dataclass's own"


@pytest.mark.parametrize("package", ["fieldstone.solve", "fieldstone.geometry"])
def test_importing_a_package_imports_nothing_slow(package):
    name = {"fieldstone.solve": "five_point", "fieldstone.geometry": "Rigid3"}[package]
    code = f"""
import sys, {package} as package
dir(package)
slow = {{"numba", "scipy", "numpy", "cv2", "torch"}} & set(sys.modules)
assert not slow, slow
package.{name}
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_name_that_is_not_public_is_refused():
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        s.nothing_of_the_kind  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
