"""Benchmarks call kernels by their arguments; what they call must stay what there is."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from benchmarks.blender_house import blender_matrix, direction
from benchmarks.field import kernel_times

from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.synthetic.light import level_camera
from grid_scenes import FRAME, ball_photos, plan_of


def test_every_kernel_of_a_step_is_timed():
    plan = plan_of(finest=32, steps=(2,) * 8, num_chunks=2, samples_per_chunk=512)
    with ThreadPoolExecutor(1) as executor:
        training = prepare_grid_training(ball_photos(), FRAME, plan, seed=0, executor=executor)
        state, _ = training.advance(training.start())
        rows, about = kernel_times(training, state)
    assert all(nanoseconds > 0 for _, nanoseconds in rows)
    assert {"march and interpolate", "decode backward", "step touched blocks"} <= {name for name, _ in rows}
    assert "samples that weigh per ray" in about


def test_blender_cameras_look_along_minus_z_at_the_origin():
    position = np.array([0.3, -0.2, 3.6]) + 20.0 * direction(0.7, 0.4)
    matrix = blender_matrix(level_camera(position, np.array([0.3, -0.2, 3.6])), 4.0 / 20.0)
    np.testing.assert_allclose(-matrix[:3, 2], -direction(0.7, 0.4), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 3], 4.0 * direction(0.7, 0.4), atol=1e-12)
    assert matrix[2, 1] > 0
