import numpy as np
import pytest

from fieldstone.field.grid.exposure import gain_at, gains_of, step_exposure, unit_exposure
from fieldstone.geometry.rigid3 import Rigid3, look_at


def test_gains_of_photos_are_found_but_for_the_mean_of_all():
    """Descent on sum (exp(theta) c - target)^2, with targets that follow known gains."""
    rng = np.random.default_rng(0)
    color = rng.uniform(0.2, 0.8, (4, 50, 3))
    true = rng.normal(scale=0.2, size=(4, 3))
    true -= true.mean(axis=0)
    target = np.exp(true)[:, None] * color
    exposure = unit_exposure(4)
    for k in range(600):
        gain = gains_of(exposure).reshape(4, 1, 3)
        gradient = ((gain * color - target) * gain * color).sum(axis=1).astype(np.float32).reshape(-1)
        step_exposure(exposure, [0.25 * gradient, 0.75 * gradient], k + 1, 0.02 * 0.99**k)
    found = exposure.log_gain.reshape(4, 3)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-6)
    # The pull towards gain 1 is a twentieth of a step.
    np.testing.assert_allclose(found, true, atol=0.02)


def test_photos_that_say_nothing_lose_what_they_had():
    exposure = unit_exposure(2)
    exposure.log_gain[:] = [0.5, 0.5, 0.5, -0.5, -0.5, -0.5]
    for k in range(200):
        step_exposure(exposure, [np.zeros(6, np.float32)], k + 1, 0.1)
    np.testing.assert_allclose(np.abs(exposure.log_gain), 0.5 * (1 - 0.1 * 0.05) ** 200, rtol=1e-3)


def test_a_new_view_takes_the_exposure_of_its_neighbours():
    up = np.array([0.0, 0, 1])
    eyes = [np.array([3 * np.cos(a), 3 * np.sin(a), 0.5]) for a in np.linspace(0, np.pi, 6)]
    poses = [look_at(eye, np.zeros(3), up) for eye in eyes]
    log_gain = np.linspace(-0.4, 0.4, 6)[:, None] * np.array([1.0, 0.5, -1.0])
    photos = Rigid3.stack(poses)
    np.testing.assert_allclose(gain_at(log_gain, poses[2], photos), np.exp(log_gain[2]), rtol=1e-2)
    between = look_at(3 * (eyes[2] + eyes[3]) / np.linalg.norm(eyes[2] + eyes[3]), np.zeros(3), up)
    assert gain_at(log_gain, between, photos) == pytest.approx(np.exp(log_gain[2:4].mean(axis=0)), rel=1e-2)
