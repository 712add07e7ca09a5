import numpy as np

from fieldstone.solve.algebra.conjugate_gradients import conjugate_gradients


def solved(*args, **options) -> np.ndarray:
    x = conjugate_gradients(*args, **options)
    assert x is not None
    return x


def system(n: int = 60, spread: float = 1e4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(n, n)))[0]
    return Q @ np.diag(np.geomspace(1.0, spread, n)) @ Q.T, rng.normal(size=n)


def test_it_solves_and_the_preconditioner_saves_steps():
    A, b = system()
    calls = []

    def apply(x):
        calls.append(1)
        return A @ x

    plain = solved(apply, b, np.copy, tolerance=1e-12, max_iterations=1000)
    num_plain = len(calls)
    inverse = np.linalg.inv(A + np.eye(60))
    helped = solved(apply, b, lambda r: inverse @ r, tolerance=1e-12, max_iterations=1000)
    for x in (plain, helped):
        np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-7, atol=1e-10)
    assert len(calls) - num_plain < num_plain / 3


def test_wherever_it_stops_the_iterate_is_the_best_of_its_space():
    A, b = system(spread=30.0)
    for steps in (1, 2, 4):
        x = solved(lambda v: A @ v, b, np.copy, tolerance=0.0, max_iterations=steps)
        krylov = np.linalg.qr(np.stack([np.linalg.matrix_power(A, k) @ b for k in range(steps)], axis=1))[0]
        best = krylov @ np.linalg.solve(krylov.T @ A @ krylov, krylov.T @ b)
        np.testing.assert_allclose(x, best, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(x @ A @ x, x @ b, rtol=1e-9)


def test_a_matrix_that_is_not_positive_definite_is_noticed():
    assert conjugate_gradients(lambda v: -v, np.ones(3), np.copy, tolerance=0.1, max_iterations=5) is None
    assert conjugate_gradients(lambda v: v, np.ones(3), lambda r: -r, tolerance=0.1, max_iterations=5) is None


def test_nothing_to_solve():
    x = solved(lambda v: v, np.zeros(3), np.copy, tolerance=0.1, max_iterations=5)
    np.testing.assert_array_equal(x, np.zeros(3))
