"""Bundle adjustment of a working model: of everything, around one view, and until nothing changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Int

from fieldstone.mapping.model.calibration import CalibrationStep, priors, with_models
from fieldstone.mapping.model.triangulation import covering_tracks, retriangulate
from fieldstone.mapping.model.working_model import WorkingModel, reprojections
from fieldstone.solve.bundle.adjustment import BundleOptions, bundle_adjust
from fieldstone.solve.bundle.problem import BundleProblem

CAUCHY_SIGMAS = 2.385
"""Where a Cauchy loss has 95 % of the efficiency of least squares under normal noise."""
MEDIAN_OF_RAYLEIGH = 1.1774
"""Median length of a 2-vector whose coordinates are normal with standard deviation 1."""
LOSS_SCALES_PX = (0.25, 2.0)
"""Keypoints are hardly better than a tenth of a pixel, and what is worse than a pixel is no noise."""


@dataclass(frozen=True)
class RefinementOptions:
    """When to adjust what, and how exactly."""

    tracks_per_view: int = 600
    """Points per photo that carry the adjustments between registrations; the last ones use all."""
    always_global: int = 16
    """Up to so many photos every adjustment is of the whole model."""
    global_growth_ratio: float = 1.15
    """Beyond, the whole model is adjusted when it has grown by this factor since the last time."""
    neighbors: int = 8
    """Photos that are adjusted together with a new one, those that share most points with it."""
    intermediate: BundleOptions = field(
        default_factory=lambda: BundleOptions(
            loss="soft_l1", max_iterations=10, relative_tolerance=1e-4, keep_gauge=True
        )
    )
    """Adjustments between registrations."""
    final: BundleOptions = field(
        default_factory=lambda: BundleOptions(
            loss="cauchy", max_iterations=50, relative_tolerance=3e-5, keep_gauge=True
        )
    )
    """The last adjustments; residuals of SIFT keypoints have heavy tails. The scale of the loss follows their noise.
    Reweighting converges slowly: steps that gain less move poses by a thousandth of their error."""
    min_views_for_intrinsics: int = 3
    """Intrinsics are refined in adjustments of so many photos at least: those of a camera once so many of its photos
    are among them, or all that it has."""
    max_rounds: int = 4
    """Rounds of adjustment and triangulation at the end."""
    threads: int = 1
    """Threads of an adjustment; results are the same for any number."""
    min_observations_for_threads: int = 10_000
    """Smaller adjustments take less time than threads cost."""

    def for_noise(self, scale_px: float) -> RefinementOptions:
        """The same with another scale of the loss of the last adjustments."""
        return replace(self, final=replace(self.final, loss_scale_px=scale_px))


Calibration = Sequence[CalibrationStep | None]


def adjust_globally(
    model: WorkingModel,
    options: RefinementOptions,
    calibration: Calibration,
    *,
    bundle: BundleOptions | None = None,
    points: Bool[np.ndarray, "t"] | None = None,
) -> WorkingModel:
    """All poses, the points that cover them (or those of a mask), and the intrinsics that may move."""
    points = covering_tracks(model, options.tracks_per_view) if points is None else points
    return _solve(model, points, model.registered, calibration, options, bundle or options.intermediate)


def adjust_locally(
    model: WorkingModel, view: int, options: RefinementOptions
) -> tuple[WorkingModel, Bool[np.ndarray, "t"]]:
    """A view and the photos that share most points with it, the rest held; also returns the points that moved."""
    rows = model.used_observations()
    mine = np.zeros(len(model.xyz), dtype=bool)
    mine[model.tracks.point[rows[model.tracks.view[rows] == view]]] = True
    shared = np.bincount(model.tracks.view[rows[mine[model.tracks.point[rows]]]], minlength=model.num_views)
    shared[view] = shared.max() + 1
    free = np.zeros(model.num_views, dtype=bool)
    free[np.argsort(-shared, kind="stable")[: options.neighbors + 1]] = True
    free &= model.registered & (shared > 0)
    touched = np.zeros(len(model.xyz), dtype=bool)
    touched[model.tracks.point[rows[free[model.tracks.view[rows]]]]] = True
    points = covering_tracks(model, options.tracks_per_view, touched)
    fixed: Calibration = (None,) * len(model.cameras)
    return _solve(model, points, free, fixed, options, options.intermediate), touched


def refine_until_stable(
    model: WorkingModel,
    options: RefinementOptions,
    calibration: Calibration,
    max_error_px: float,
    min_angle_deg: float,
    *,
    bundle: BundleOptions | None = None,
    all_points: bool = False,
) -> WorkingModel:
    """Rounds of adjustment and of triangulating everything anew, until hardly an observation changes sides."""
    model = retriangulate(model, model.all_tracks(), max_error_px=max_error_px, min_angle_deg=min_angle_deg)
    for _ in range(options.max_rounds):
        before = model.used_observations()
        model = adjust_globally(
            model, options, calibration, bundle=bundle, points=model.is_point() if all_points else None
        )
        model = retriangulate(model, model.all_tracks(), max_error_px=max_error_px, min_angle_deg=min_angle_deg)
        changed = len(np.setxor1d(before, model.used_observations(), assume_unique=True))
        if changed < 1e-3 * len(before):
            break
    return model


def loss_scale(model: WorkingModel) -> float:
    """Where a Cauchy loss should bend, over the pixel scales, for the noise of a model's observations.

    It then loses 5 % of the efficiency of least squares if the noise is normal, and wins if its tails are heavier.

    Source:
        `holland1977`.
    """
    errors = reprojections(model).scaled_errors
    sigma = float(np.median(errors)) / MEDIAN_OF_RAYLEIGH if len(errors) else 1.0
    return float(np.clip(CAUCHY_SIGMAS * sigma, *LOSS_SCALES_PX))


def _solve(
    model: WorkingModel,
    points: Bool[np.ndarray, "t"],
    free: Bool[np.ndarray, "v"],
    calibration: Calibration,
    options: RefinementOptions,
    bundle: BundleOptions,
) -> WorkingModel:
    """Adjust the free views and the points of a mask; other registered views that see these points hold them."""
    problem, registered, ids = bundle_problem(model, points, free, calibration, options.min_views_for_intrinsics)
    threads = options.threads if len(problem.view) >= options.min_observations_for_threads else 1
    bundle = replace(bundle, camera_priors=priors(problem.cameras, calibration), threads=threads)
    result = bundle_adjust(problem, bundle)
    return model.with_adjusted(result.problem, registered, ids)


def bundle_problem(
    model: WorkingModel,
    points: Bool[np.ndarray, "t"],
    free: Bool[np.ndarray, "v"],
    calibration: Calibration,
    min_views_for_intrinsics: int,
) -> tuple[BundleProblem, list[int], Int[np.ndarray, "p"]]:
    """The problem, and which views and tracks its poses and points are.

    The gauge stays free unless held views fix it: damping keeps the solution near its start.
    """
    model = replace(model, cameras=with_models(model.cameras, calibration))
    rows = model.used_observations()
    rows = rows[points[model.tracks.point[rows]]]
    registered = np.unique(model.tracks.view[rows]).tolist()
    ids, point = np.unique(model.tracks.point[rows], return_inverse=True)
    camera_of_view = model.camera_of_view[registered]
    free_views_of_camera = np.bincount(camera_of_view[free[registered]], minlength=len(model.cameras))
    needed = np.clip(np.bincount(model.camera_of_view, minlength=len(model.cameras)), 1, min_views_for_intrinsics)
    enough = (free_views_of_camera >= needed) & (free_views_of_camera.sum() >= min_views_for_intrinsics)
    refine = tuple(
        step.mask() if step is not None and enough[c] else np.zeros(len(camera.params), dtype=bool)
        for c, (camera, step) in enumerate(zip(model.cameras, calibration, strict=True))
    )
    problem = BundleProblem(
        cameras=model.cameras,
        camera_of_view=camera_of_view,
        cam_from_world=model.cam_from_world[registered],
        points=model.xyz[ids],
        view=np.searchsorted(registered, model.tracks.view[rows]),
        point=point,
        pixels=model.tracks.pixels[rows],
        fixed_views=~free[registered],
        fixed_points=np.zeros(len(ids), dtype=bool),
        refine=refine,
        pixel_scale=model.pixel_scale[registered],
    )
    return problem, registered, ids
