from dataclasses import replace

import numpy as np
import pytest

from bundle_worlds import mixed_problem, perturbed, without_refinement
from fieldstone.geometry import rotation
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.solve.bundle.buffers import Values, allocate_linearization, start_values
from fieldstone.solve.bundle.layout import lay_out
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_residuals, updated
from fieldstone.solve.bundle.schur import damped_step, normal_equations, reduced_camera_system
from fieldstone.solve.bundle.schur_solver import camera_system, linearize, move, schur_solver
from fieldstone.solve.bundle.schur_step import solve_step
from fieldstone.solve.bundle.tile_pattern import tile_pattern
from fieldstone.solve.bundle.workers import started_workers
from fieldstone.solve.robust.loss import cauchy, huber, trivial

PIVOT = np.array([0.3, -0.2, 0.5])
ZERO = np.zeros(3)
PROBLEMS = {
    "mixed": perturbed(mixed_problem()),
    "nothing held": perturbed(mixed_problem(fixed=False)),
    "poses only": perturbed(without_refinement(mixed_problem())),
    "many views": perturbed(mixed_problem(num_views=45, num_points=40)),
    "sparse": perturbed(mixed_problem(num_views=100, num_points=150, reach=3)),
    "points only": replace(without_refinement(perturbed(mixed_problem())), fixed_views=np.ones(6, dtype=bool)),
    "pixel scales": replace(perturbed(mixed_problem()), pixel_scale=np.array([1.0, 0.5, 3.0, 1.0, 2.0, 0.7])),
    "cameras only": replace(perturbed(mixed_problem()), fixed_points=np.ones(30, dtype=bool)),
}


def compiled_step(
    problem: BundleProblem,
    loss: tuple[int, float],
    damping: float,
    *,
    direct: bool = True,
    tolerance: float = 1e-13,
    threads: int = 1,
) -> tuple[Values, float, float]:
    layout = lay_out(problem, np.ones(len(problem.view), dtype=bool))._replace(pivot=PIVOT)
    values, at = start_values(problem, layout), allocate_linearization(layout)
    pattern = tile_pattern(layout, None if direct else -1.0)
    assert pattern.direct == direct
    with started_workers(threads) as workers:
        solver = schur_solver(layout, pattern, loss, workers)
        cost = linearize(solver, values, at)
        system = camera_system(solver, values, at)
        step = solve_step(solver, values, at, system, damping, pcg_tolerance=tolerance)
        assert step is not None
        moved, promised = move(solver, values, at, step, damping)
    points = np.empty_like(moved.points)
    points[layout.point_order] = moved.points
    return moved._replace(points=points), cost, promised


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize(
    ("number", "loss", "direct"),
    [(0, trivial(), True), (0, trivial(), False), (1, huber(5.0), True), (3, cauchy(5.0), True)],
)
def test_compiled_step_matches_the_reference(name, number, loss, direct):
    problem, damping = PROBLEMS[name], 1e-3
    moved, cost, promised = compiled_step(problem, (number, 25.0), damping, direct=direct)
    equations = normal_equations(problem, loss, PIVOT)
    step = damped_step(problem, loss, PIVOT, damping)
    assert cost == pytest.approx(equations.cost, rel=1e-12)
    R = problem.cam_from_world.R @ rotation.exp(step.pose_tangent[:, :3])
    t = problem.cam_from_world.t + np.einsum("vij,vj->vi", problem.cam_from_world.R, PIVOT + step.pose_tangent[:, 3:])
    np.testing.assert_allclose(moved.R, R, atol=1e-9)
    np.testing.assert_allclose(moved.t, t - R @ PIVOT, atol=1e-9)
    np.testing.assert_allclose(moved.points, problem.points + step.point_step, atol=1e-9)
    for row, camera, change in zip(moved.params, problem.cameras, step.camera_step, strict=True):
        np.testing.assert_allclose(row[: len(camera.params)], camera.params + change[: len(camera.params)], rtol=1e-9)
    delta = np.concatenate([step.pose_tangent.ravel(), step.camera_step.ravel(), step.point_step.ravel()])
    decrease = -equations.gradient @ delta - 0.5 * delta @ equations.H @ delta
    assert promised == pytest.approx(decrease, rel=1e-7)


def tangent_of(problem: BundleProblem, moved: Values) -> np.ndarray:
    """The step that led from the problem to other values, in the order of the reference's columns."""
    R, t = problem.cam_from_world.R, problem.cam_from_world.t
    omega = rotation.log(np.swapaxes(R, 1, 2) @ moved.R)
    v = np.einsum("vji,vj->vi", R, moved.t + moved.R @ PIVOT - t) - PIVOT
    longest = max(len(camera.params) for camera in problem.cameras)
    cameras = np.zeros((len(problem.cameras), longest))
    for row, new, camera in zip(cameras, moved.params, problem.cameras, strict=True):
        row[: len(camera.params)] = new[: len(camera.params)] - camera.params
    poses = np.concatenate([omega, v], axis=1)
    return np.concatenate([poses.ravel(), cameras.ravel(), (moved.points - problem.points).ravel()])


@pytest.mark.parametrize("name", ["mixed", "sparse"])
def test_a_rough_solution_promises_what_the_linear_model_says(name):
    problem, damping = PROBLEMS[name], 1e-3
    exact, _, most = compiled_step(problem, (0, 25.0), damping)
    rough, _, promised = compiled_step(problem, (0, 25.0), damping, direct=False, tolerance=0.3)
    equations, delta = normal_equations(problem, trivial(), PIVOT), tangent_of(problem, rough)
    decrease = -equations.gradient @ delta - 0.5 * delta @ equations.H @ delta
    assert promised == pytest.approx(decrease, rel=1e-6)
    assert 0.5 * most < promised < most
    assert not np.allclose(exact.t, rough.t, atol=1e-9)


@pytest.mark.parametrize("direct", [True, False])
def test_steps_are_the_same_for_any_number_of_threads(direct):
    one, *costs = compiled_step(PROBLEMS["sparse"], (0, 25.0), 1e-3, direct=direct, tolerance=0.1)
    three, *other_costs = compiled_step(PROBLEMS["sparse"], (0, 25.0), 1e-3, direct=direct, tolerance=0.1, threads=3)
    assert costs == other_costs
    for name in ("R", "t", "points", "params"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


@pytest.mark.parametrize("name", ["mixed", "nothing held", "cameras only"])
def test_reference_step_solves_the_whole_damped_system(name):
    problem, damping = PROBLEMS[name], 1e-3
    equations = normal_equations(problem, trivial(), ZERO)
    free = equations.free & (np.diag(equations.H) > 0)
    H = equations.H[np.ix_(free, free)]
    whole = np.linalg.solve(H + damping * np.diag(np.diag(H)), -equations.gradient[free])
    step = damped_step(problem, trivial(), ZERO, damping)
    parts = np.concatenate([step.pose_tangent.ravel(), step.camera_step.ravel(), step.point_step.ravel()])
    np.testing.assert_allclose(parts[free], whole, rtol=1e-6, atol=1e-10)
    np.testing.assert_array_equal(parts[~free], 0.0)


def test_reference_gradient_is_that_of_the_cost():
    problem = PROBLEMS["mixed"]
    equations = normal_equations(problem, trivial(), ZERO)

    def cost(delta: np.ndarray) -> float:
        poses, cameras, points = np.split(delta, [36, 36 + 3 * 8])
        steps = [row[: len(c.params)] for row, c in zip(cameras.reshape(3, 8), problem.cameras, strict=True)]
        moved = updated(problem, poses.reshape(6, 6), points.reshape(-1, 3), tuple(steps))
        return 0.5 * float(np.sum(reprojection_residuals(moved) ** 2))

    numeric = np.array([(cost(1e-6 * e) - cost(-1e-6 * e)) / 2e-6 for e in np.eye(len(equations.gradient))])
    free = equations.free
    np.testing.assert_allclose(equations.gradient[free], numeric[free], rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(equations.gradient[~free], 0.0)


def test_reduced_system_is_the_schur_complement_of_the_whole():
    """det(H) = det(V) det(S), and the pose block of the inverse of H is the inverse of S."""
    equations = normal_equations(PROBLEMS["mixed"], trivial(), ZERO)
    S, _ = reduced_camera_system(equations, 0.1)
    H = equations.H + np.diag(np.where(np.diag(equations.H) > 0, 0.1 * np.diag(equations.H), 1.0))
    m = equations.num_camera_columns
    np.testing.assert_allclose(np.linalg.inv(H)[:m, :m], np.linalg.inv(S), rtol=1e-6, atol=1e-12)


def test_the_pivot_changes_the_path_but_not_the_undamped_step():
    """Tangents about another centre are another basis: with no damping the moved poses are the same to first order."""
    problem = mixed_problem(noise_px=1e-4)
    near, far = (damped_step(problem, trivial(), pivot, 1e-14) for pivot in (ZERO, PIVOT))
    a = problem.cam_from_world.retract(near.pose_tangent)
    omega, v = far.pose_tangent[:, :3], far.pose_tangent[:, 3:]
    b = problem.cam_from_world.retract(np.concatenate([omega, v + np.cross(PIVOT, omega)], axis=1))
    assert isinstance(a, Rigid3)
    np.testing.assert_allclose(a.t, b.t, atol=1e-6)
    np.testing.assert_allclose(near.point_step, far.point_step, atol=1e-7)
