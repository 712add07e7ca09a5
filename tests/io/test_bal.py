from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.geometry.camera import Camera
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import exp
from fieldstone.io.models.bal import read_bal, write_bal
from fieldstone.solve.bundle.problem import BundleProblem, reprojection_residuals
from matchers import assert_rigid3_near
from mutations import check_mutations
from real_data import data_folder


def small_problem(model: str = "RADIAL") -> BundleProblem:
    rng = np.random.default_rng(0)
    params = {"RADIAL": [500.0, 0, 0, -0.1, 0.01], "SIMPLE_PINHOLE": [400.0, 320, 240]}[model]
    camera = Camera(model, 640, 480, np.array(params))
    view, point = np.divmod(np.arange(12), 4)
    return BundleProblem(
        cameras=(camera,) * 3,
        camera_of_view=np.arange(3),
        cam_from_world=Rigid3(exp(rng.normal(size=(3, 3))), rng.normal(size=(3, 3))),
        points=rng.normal(size=(4, 3)),
        view=view,
        point=point,
        pixels=rng.uniform(-200, 200, size=(12, 2)),
        fixed_views=np.zeros(3, dtype=bool),
        fixed_points=np.zeros(4, dtype=bool),
        refine=(np.ones(len(params), dtype=bool),) * 3,
    )


def test_projects_as_the_format_defines(tmp_path):
    """The published equations: P = R X + t, p = -P / P_z, pixel = f (1 + k1 |p|^2 + k2 |p|^4) p, y up."""
    omega, t, f, k1, k2 = np.array([0.1, -0.2, 0.3]), np.array([0.1, 0.2, -5.0]), 500.0, -0.1, 0.02
    X = np.array([0.4, 0.3, 0.2])
    P = exp(omega) @ X + t
    p = -P[:2] / P[2]
    pixel = f * (1 + k1 * p @ p + k2 * (p @ p) ** 2) * p
    path = tmp_path / "one.txt"
    numbers = [*omega, *t, f, k1, k2, *X]
    path.write_text(f"1 1 1\n\n0 0 {float(pixel[0])} {float(pixel[1])}\n" + "\n".join(map(str, map(float, numbers))))
    problem = read_bal(path)
    assert np.abs(reprojection_residuals(problem)).max() < 1e-10


@pytest.mark.parametrize("model", ["RADIAL", "SIMPLE_PINHOLE"])
def test_round_trip_keeps_every_digit(tmp_path, model):
    problem = small_problem(model)
    write_bal(problem, tmp_path / "a.txt")
    first = read_bal(tmp_path / "a.txt")
    assert_rigid3_near(first.cam_from_world, problem.cam_from_world, angle=1e-14, distance=1e-14)
    np.testing.assert_array_equal(first.points, problem.points)
    np.testing.assert_allclose(first.pixels, problem.pixels - problem.cameras[0].principal_point, rtol=1e-15)
    np.testing.assert_array_equal(first.view, problem.view)
    write_bal(first, tmp_path / "b.txt")
    again = read_bal(tmp_path / "b.txt")
    np.testing.assert_array_equal(again.pixels, first.pixels)
    assert_rigid3_near(again.cam_from_world, first.cam_from_world, angle=1e-14, distance=1e-14)


def test_models_without_a_place_in_the_format_are_refused(tmp_path):
    problem = small_problem()
    camera = Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]))
    problem = replace(problem, cameras=(camera,) * 3, refine=(np.ones(4, dtype=bool),) * 3)
    with pytest.raises(InputError, match="PINHOLE"):
        write_bal(problem, tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:8], "ends after 7"),
        (lambda lines: lines[:-1], "cut off"),
        (lambda lines: [*lines, "1.0"], "longer"),
        (lambda lines: [lines[0], "0 0 x 1.0", *lines[2:]], "line 2"),
        (lambda lines: [lines[0], "0 9 1.0 1.0", *lines[2:]], "line 2: point 9"),
        (lambda lines: [lines[0], "-1 0 1.0 1.0", *lines[2:]], "line 2"),
        (lambda lines: [*lines[:-1], "nan"], "line 52"),
        (lambda lines: [*lines[:2], "0 1 1.0", "2.0 0 2 1.0 1.0", *lines[4:]], "line 3"),
        (lambda lines: ["1 2", *lines[1:]], "line 1"),
        (lambda lines: [], "line 1"),
        (lambda lines: [*lines[:19], "-500", *lines[20:]], "camera 0"),
    ],
)
def test_damage_is_named(tmp_path, change, message):
    path = tmp_path / "a.txt"
    write_bal(small_problem(), path)
    path.write_text("\n".join(change(path.read_text().splitlines())))
    with pytest.raises(InputError, match=message):
        read_bal(path)


def test_no_such_file_and_binary(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_bal(tmp_path / "none.txt")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot be read"):
        read_bal(tmp_path / "binary")


def test_random_damage_is_refused_or_loaded_correctly(tmp_path):
    path = tmp_path / "a.txt"
    write_bal(small_problem(), path)

    def check(problem: BundleProblem) -> None:
        assert np.all(np.isfinite(problem.points))
        assert np.all(np.isfinite(problem.cam_from_world.matrix()))

    check_mutations(path, lambda: read_bal(path), check, count=300)


@pytest.mark.parametrize(
    ("name", "cost"), [("problem-21-11315-pre.txt", 4.413239e6), ("dubrovnik-3-7-pre.txt", 2.764220e3)]
)
def test_published_initial_costs(name, cost):
    residuals = reprojection_residuals(read_bal(data_folder("bal") / name))
    assert 0.5 * np.sum(residuals**2) == pytest.approx(cost, rel=1e-6)
