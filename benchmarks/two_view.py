"""Relative pose of real photo pairs with known poses: ours against PoseLib and OpenCV, interleaved pair by pair.

    python -m benchmarks.two_view [FOLDER ...] [--max-error-px 1.0] [--seeds 3] [--size 1600] [--out ROWS.json]

Matches: OpenCV SIFT, RootSIFT, mutual nearest neighbours with ratio 0.8 both ways. Pairs with fewer than 30 matches
are left out. The error of a pair is the larger of the angles of rotation and of translation direction. Times are CPU
milliseconds of one thread for the estimation alone (our undistortion, decisions and inlier masks included).
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.data import DATA, present
from benchmarks.ground_truth import read_ground_truth
from benchmarks.rows import QUALITY, TIMES, Row, add_out_option, write_rows
from fieldstone.evaluate.reconstruction_metrics import area_under_curve
from fieldstone.geometry.camera import Camera, plane_from_image, rescale
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.rotation import angle_between
from fieldstone.solve.robust.ransac import RansacOptions
from fieldstone.solve.robust.two_view import TwoViewOptions, estimate_two_view

MIN_MATCHES = 30
CONFIDENCE = 0.9999
DEFAULT_NAMES = ("strecha_fountain_p11", "strecha_entry_p10")
THRESHOLDS_DEG = (0.25, 1.0, 5.0, 10.0)


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches of two photos and their true relative pose."""

    camera1: Camera
    camera2: Camera
    pixels1: np.ndarray
    pixels2: np.ndarray
    cam2_from_cam1: Rigid3


def main() -> None:
    """Measure every method on every pair and print one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[DATA / name for name in DEFAULT_NAMES])
    parser.add_argument("--max-error-px", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--size", type=int, default=1600)
    add_out_option(parser, "two_view")
    arguments = parser.parse_args()
    folders = present(arguments.folders)
    if not folders:
        return
    cv2.setNumThreads(1)
    pairs = [pair for folder in folders for pair in read_pairs(folder, arguments.size)]
    counts = np.median([len(pair.pixels1) for pair in pairs])
    sys.stdout.write(f"{len(pairs)} pairs, median {counts:.0f} matches, threshold {arguments.max_error_px} px\n")
    methods = available_methods(arguments.max_error_px)
    for run in methods.values():
        run(pairs[0], 0)
    errors = {name: [] for name in methods}
    times = {name: [] for name in methods}
    for seed, (index, pair) in itertools.product(range(arguments.seeds), enumerate(pairs)):
        for name, run in methods.items():
            start = time.thread_time()
            pose = run(pair, seed * len(pairs) + index)
            times[name].append(1e3 * (time.thread_time() - start))
            errors[name].append(180.0 if pose is None else error_deg(pose, pair.cam2_from_cam1))
    columns = " ".join(f"{f'AUC@{t:g}':>9s}" for t in THRESHOLDS_DEG)
    sys.stdout.write(f"{'method':28s} {columns} {'ms mean':>8s} {'median':>8s}\n")
    for name in methods:
        curve = area_under_curve(np.array(errors[name]), THRESHOLDS_DEG)
        areas = " ".join(f"{area:9.2f}" for area in curve)
        sys.stdout.write(f"{name:28s} {areas} {np.mean(times[name]):8.2f} {np.median(times[name]):8.2f}\n")
    write_rows(rows_of(errors, times), arguments.out)


def rows_of(errors: dict[str, list[float]], times: dict[str, list[float]]) -> list[Row]:
    """Areas under the curve of errors, and CPU time, against PoseLib or else OpenCV."""
    peer = "PoseLib" if "PoseLib" in errors else "OpenCV USAC_DEFAULT"
    ours, others = (area_under_curve(np.array(errors[name]), THRESHOLDS_DEG) for name in ("fieldstone", peer))
    rows = [
        Row(f"two_view/AUC at {threshold:g} deg", float(a), "%", "higher", QUALITY, peer, float(b))
        for threshold, a, b in zip(THRESHOLDS_DEG, ours, others, strict=True)
    ]
    means = (float(np.mean(times[name])) for name in ("fieldstone", peer))
    return [*rows, Row("two_view/cpu mean", next(means), "ms", "lower", TIMES, peer, next(means))]


def error_deg(found: Rigid3, truth: Rigid3) -> float:
    """Larger of the angles of rotation and of translation direction, in degrees."""
    direction = np.arctan2(np.linalg.norm(np.cross(found.t, truth.t)), found.t @ truth.t)
    return float(np.rad2deg(max(float(angle_between(found.R, truth.R)), float(direction))))


def read_pairs(folder: Path, size: int) -> list[Pair]:
    """All pairs of a folder with ground truth that have enough matches."""
    truth = read_ground_truth(folder)
    if truth is None:
        raise SystemExit(f"{folder}: no ground truth")
    model, paths = truth, {path.name: path for path in (folder / "images").iterdir()}
    found = []
    for view in model.views:
        image = cv2.imread(str(paths[view.name]), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SystemExit(f"{paths[view.name]}: not a readable image")
        scale = size / max(image.shape)
        small = cv2.resize(
            image, (round(image.shape[1] * scale), round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA
        )
        keypoints, descriptors = cv2.SIFT.create(nfeatures=8192).detectAndCompute(small, None)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)).astype(np.float32)
        camera = rescale(model.cameras[view.camera], small.shape[1], small.shape[0])
        pixels = np.array([k.pt for k in keypoints], dtype=np.float64) + 0.5
        found.append((camera, pixels, root, view.cam_from_world))
    pairs = []
    for (camera1, pixels1, root1, pose1), (camera2, pixels2, root2, pose2) in itertools.combinations(found, 2):
        rows = mutual_matches(root1, root2)
        if len(rows) >= MIN_MATCHES and pose1 is not None and pose2 is not None:
            cam2_from_cam1 = pose2 @ pose1.inverse()
            pairs.append(Pair(camera1, camera2, pixels1[rows[:, 0]], pixels2[rows[:, 1]], cam2_from_cam1))
    return pairs


def mutual_matches(a: np.ndarray, b: np.ndarray, max_ratio: float = 0.8) -> np.ndarray:
    """Mutual nearest neighbours of unit descriptors whose ratio test holds both ways, (m, 2)."""
    similarity = a @ b.T
    best = []
    for S in (similarity, similarity.T):
        two = np.argpartition(-S, 1, axis=1)[:, :2]
        values = np.take_along_axis(S, two, axis=1)
        order = np.argsort(-values, axis=1)
        two, values = np.take_along_axis(two, order, axis=1), np.take_along_axis(values, order, axis=1)
        distance = np.sqrt(np.maximum(2 - 2 * values, 0))
        best.append((two[:, 0], distance[:, 0] < max_ratio * distance[:, 1]))
    (j_of_i, good_i), (i_of_j, good_j) = best
    i = np.flatnonzero((i_of_j[j_of_i] == np.arange(len(a))) & good_i & good_j[j_of_i])
    return np.stack([i, j_of_i[i]], axis=1)


def available_methods(max_error_px: float) -> dict[str, Callable[[Pair, int], Rigid3 | None]]:
    """Ours, OpenCV, and PoseLib where it is installed."""
    options = TwoViewOptions(RansacOptions(max_error_px=max_error_px, confidence=CONFIDENCE, min_trials=30), 8)

    def ours(pair: Pair, seed: int) -> Rigid3 | None:
        rng = np.random.default_rng(seed)
        found = estimate_two_view(pair.camera1, pair.camera2, pair.pixels1, pair.pixels2, options, rng)
        return found.cam2_from_cam1

    def usac(pair: Pair, seed: int) -> Rigid3 | None:
        uv1, uv2 = plane_from_image(pair.camera1, pair.pixels1), plane_from_image(pair.camera2, pair.pixels2)
        threshold = max_error_px / float(np.sqrt(pair.camera1.focal.prod()))
        E, mask = cv2.findEssentialMat(uv1, uv2, np.eye(3), cv2.USAC_DEFAULT, CONFIDENCE, threshold)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, _ = cv2.recoverPose(E, uv1, uv2, np.eye(3), mask=mask)
        return Rigid3(R, t[:, 0])

    methods: dict[str, Callable[[Pair, int], Rigid3 | None]] = {"fieldstone": ours, "OpenCV USAC_DEFAULT": usac}
    try:
        import poselib
    except ImportError:
        return methods

    def with_poselib(min_iterations: int) -> Callable[[Pair, int], Rigid3 | None]:
        def run(pair: Pair, seed: int) -> Rigid3 | None:
            cameras = [
                {"model": "PINHOLE", "width": c.width, "height": c.height, "params": c.params.tolist()}
                for c in (pair.camera1, pair.camera2)
            ]
            ransac = {
                "max_epipolar_error": max_error_px,
                "seed": seed,
                "min_iterations": min_iterations,
                "success_prob": CONFIDENCE,
            }
            pose, _ = poselib.estimate_relative_pose(pair.pixels1, pair.pixels2, *cameras, ransac, {})
            return Rigid3(pose.R, pose.t / max(float(np.linalg.norm(pose.t)), 1e-12))

        return run

    return methods | {"PoseLib": with_poselib(1000), "PoseLib, 100 trials": with_poselib(100)}


if __name__ == "__main__":
    main()
