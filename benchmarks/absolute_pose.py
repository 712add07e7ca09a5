"""Absolute pose from generated correspondences with outliers: ours against PoseLib and OpenCV, interleaved.

    python -m benchmarks.absolute_pose [--points 1000] [--noise-px 0.5] [--draws 100] [--out ROWS.json]

Median and 95th percentile of the rotation error and of the position error (relative to the depth of the scene), the
share of draws that fail (over 1 degree), and CPU milliseconds of one thread.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from benchmarks.rows import TIMES, Row, add_out_option, write_rows
from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between, exp, random_rotation
from fieldstone.solve.robust.absolute_pose import estimate_absolute_pose
from fieldstone.solve.robust.ransac import RansacOptions

CAMERA = Camera("PINHOLE", 1600, 1200, np.array([1400.0, 1400.0, 800.0, 600.0]))
OUTLIERS = (0.3, 0.5, 0.7, 0.9)
MAX_ERROR_PX = 4.0
CONFIDENCE = 0.9999
Method = Callable[[np.ndarray, np.ndarray, int], Rigid3 | None]


def main() -> None:
    """Measure every method at every share of outliers and print one table each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1000)
    parser.add_argument("--noise-px", type=float, default=0.5)
    parser.add_argument("--draws", type=int, default=100)
    add_out_option(parser, "absolute_pose")
    arguments = parser.parse_args()
    measured: list[Row] = []
    cv2.setNumThreads(1)
    methods = available_methods()
    header = f"{'method':24s} {'rot mdeg':>9s} {'95 %':>9s} {'pos 1e-6':>9s} {'95 %':>9s} {'failed':>7s}"
    for outliers in OUTLIERS:
        rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in methods}
        for seed in range(-1, arguments.draws):
            rng = np.random.default_rng([seed + 1, round(100 * outliers)])
            truth, pixels, points = draw(arguments.points, arguments.noise_px, outliers, rng)
            for name, run in methods.items():
                start = time.thread_time()
                pose = run(pixels, points, seed + 1)
                elapsed = 1e3 * (time.thread_time() - start)
                if seed >= 0:
                    rows[name].append((*errors(pose, truth), elapsed))
        sys.stdout.write(f"{outliers:.0%} outliers\n{header} {'ms mean':>8s} {'median':>8s}\n")
        for name, values in rows.items():
            rotation, position, ms = np.array(values).T
            sys.stdout.write(
                f"{name:24s} {1e3 * np.median(rotation):9.3f} {1e3 * np.quantile(rotation, 0.95):9.3f} "
                f"{1e6 * np.median(position):9.1f} {1e6 * np.quantile(position, 0.95):9.1f} "
                f"{np.mean(rotation > 1):7.0%} {ms.mean():8.2f} {np.median(ms):8.2f}\n"
            )
        measured += rows_of(outliers, {name: np.array(values) for name, values in rows.items()})
    write_rows(measured, arguments.out)


def rows_of(outliers: float, draws: dict[str, np.ndarray]) -> list[Row]:
    """Errors and CPU time (n 3: degrees, share of the depth, milliseconds), against PoseLib or else OpenCV."""
    peer = "PoseLib" if "PoseLib" in draws else "OpenCV USAC"

    def row(metric: str, unit: str, number: Callable[[np.ndarray], Any]) -> Row:
        name = f"absolute_pose/{outliers:.0%} outliers/{metric}"
        return Row(name, float(number(draws["fieldstone"])), unit, "lower", TIMES, peer, float(number(draws[peer])))

    return [
        row("rotation median", "mdeg", lambda values: 1e3 * np.median(values[:, 0])),
        row("failed", "share", lambda values: np.mean(values[:, 0] > 1)),
        row("cpu mean", "ms", lambda values: np.mean(values[:, 2])),
    ]


def draw(n: int, noise_px: float, outliers: float, rng: np.random.Generator) -> tuple[Rigid3, np.ndarray, np.ndarray]:
    """cam_from_world, pixels and points of one scene, depths 3 to 9."""
    cam_from_world = Rigid3(random_rotation(1, rng)[0], rng.normal(size=3))
    pixels = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], size=(n, 2))
    uv = plane_from_image(CAMERA, pixels)
    in_cam = np.concatenate([uv, np.ones((n, 1))], axis=1) * rng.uniform(3, 9, size=(n, 1))
    seen = image_from_cam(CAMERA, in_cam) + noise_px * rng.normal(size=(n, 2))
    wrong = rng.permutation(n) < round(outliers * n)
    seen[wrong] = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], size=(int(wrong.sum()), 2))
    return cam_from_world, seen, cam_from_world.inverse().apply(in_cam)


def errors(found: Rigid3 | None, truth: Rigid3) -> tuple[float, float]:
    """Rotation error in degrees and position error over the mean depth of the scene."""
    if found is None:
        return 180.0, 1.0
    distance = np.linalg.norm(found.target_origin_in_source() - truth.target_origin_in_source())
    return float(np.rad2deg(angle_between(found.R, truth.R))), float(distance / 6.0)


def available_methods() -> dict[str, Method]:
    """Ours, OpenCV, and PoseLib where it is installed."""
    options = RansacOptions(max_error_px=MAX_ERROR_PX, confidence=CONFIDENCE, min_trials=50)

    def ours(pixels: np.ndarray, points: np.ndarray, seed: int) -> Rigid3 | None:
        found = estimate_absolute_pose(CAMERA, pixels, points, options, np.random.default_rng(seed))
        return None if found is None else found.cam_from_world

    def usac(pixels: np.ndarray, points: np.ndarray, seed: int) -> Rigid3 | None:
        usac_options = cv2.UsacParams()
        usac_options.randomGeneratorState = seed
        usac_options.confidence = CONFIDENCE
        usac_options.maxIterations = 10_000
        usac_options.threshold = MAX_ERROR_PX
        good, _, omega, t, _ = cv2.solvePnPRansac(
            points, pixels, CAMERA.calibration_matrix(), np.zeros(4), params=usac_options
        )
        return Rigid3(exp(omega[:, 0]), t[:, 0]) if good else None

    methods: dict[str, Method] = {"fieldstone": ours, "OpenCV USAC": usac}
    try:
        import poselib
    except ImportError:
        return methods
    camera = {"model": "PINHOLE", "width": 1600, "height": 1200, "params": CAMERA.params.tolist()}

    def with_poselib(min_iterations: int) -> Method:
        def run(pixels: np.ndarray, points: np.ndarray, seed: int) -> Rigid3 | None:
            ransac = {
                "max_reproj_error": MAX_ERROR_PX,
                "seed": seed,
                "min_iterations": min_iterations,
                "success_prob": CONFIDENCE,
            }
            pose, _ = poselib.estimate_absolute_pose(pixels, points, camera, ransac, {})
            return Rigid3(pose.R, pose.t)

        return run

    return methods | {"PoseLib, 50 trials": with_poselib(50), "PoseLib": with_poselib(1000)}


if __name__ == "__main__":
    main()
