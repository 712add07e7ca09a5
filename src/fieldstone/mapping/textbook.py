"""Structure from motion as in the textbook, one function per stage: the readable reference.

Pairs: fundamental matrix in RANSAC, essential matrix. Start: four poses, cheirality, linear and non-linear
triangulation. Every further photo: linear PnP, PnP in RANSAC, non-linear PnP, new points. Then bundle adjustment over
the visibility matrix. Between stages observations that do not fit are dropped, and every drop is counted.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Int

from fieldstone.geometry.camera import Camera, image_from_cam, plane_from_image
from fieldstone.geometry.epipolar import essential_from_fundamental, essential_from_pose, poses_from_essential
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.triangulation import choose_by_cheirality, triangulate_linear, triangulation_angles
from fieldstone.mapping.model.outliers import drop_outliers, recall_observations, triangulate_new_points
from fieldstone.mapping.model.working_model import WorkingModel, record_views, reprojections, to_reconstruction
from fieldstone.progress import OnProgress, StageProgress, silent
from fieldstone.scene.mapping_run import Drop, InitialPair, MappingRun, StageRecord
from fieldstone.scene.match_graph import ImagePair, MatchGraph, TwoView
from fieldstone.scene.tracks import build_tracks
from fieldstone.solve.bundle.problem import BundleProblem
from fieldstone.solve.bundle.scipy_reference import bundle_adjust_scipy
from fieldstone.solve.minimal.eight_point import FundamentalEstimator
from fieldstone.solve.minimal.linear_pnp import PnpEstimator, pnp_linear, pose_from_matrix
from fieldstone.solve.robust.loss import soft_l1
from fieldstone.solve.robust.nonlinear import pnp_nonlinear
from fieldstone.solve.robust.ransac import RansacOptions, ransac

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TextbookOptions:
    """Thresholds of the textbook mapper."""

    two_view: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=1.5))
    """RANSAC over fundamental matrices; Sampson error."""
    pnp: RansacOptions = field(default_factory=lambda: RansacOptions(max_error_px=4.0))
    """RANSAC over poses; reprojection error."""
    min_pair_inliers: int = 15
    """A pair with fewer matches that agree with one fundamental matrix is no pair."""
    min_registration_inliers: int = 12
    """A photo with fewer points that agree with one pose is not registered."""
    max_error_px: float = 4.0
    """Observations with a larger reprojection error are dropped."""
    min_angle_deg: float = 1.5
    """Points whose rays all meet at a smaller angle are dropped."""
    robust_scale_px: float = 1.0
    """Scale of the soft-L1 loss of the non-linear refinements."""
    max_rounds: int = 5
    """Rounds of bundle adjustment, dropping and recalling observations at the end."""
    refine_focal: bool = False
    """Refine the focal lengths in the bundle adjustments of the last rounds."""

    def __post_init__(self) -> None:
        if self.min_registration_inliers < 6 or self.min_pair_inliers < 8:
            raise ValueError("a pose needs at least 6 inliers, a fundamental matrix 8")
        if not (self.max_error_px > 0 and self.min_angle_deg >= 0 and self.robust_scale_px > 0):
            raise ValueError("max_error_px and robust_scale_px must be positive, min_angle_deg not negative")


def for_pixel_scale(options: TextbookOptions, scale: float) -> TextbookOptions:
    """The same thresholds for photos with so many pixels per pixel of the detector."""
    return replace(
        options,
        two_view=replace(options.two_view, max_error_px=scale * options.two_view.max_error_px),
        pnp=replace(options.pnp, max_error_px=scale * options.pnp.max_error_px),
        max_error_px=scale * options.max_error_px,
        robust_scale_px=scale * options.robust_scale_px,
    )


def map_textbook(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TextbookOptions,
    seed: int,
    on_progress: OnProgress = silent,
) -> MappingRun:
    """Camera poses and points from matches between photos of known calibration.

    Returns:
        The model that the best initial pair starts. It has no registered photo, and no `initial_pair`,
        if no pair of photos gives a start.
    """
    graph = estimate_essential_matrices(graph, cameras, camera_of_image, options, seed)
    tracks, statistics = build_tracks(graph)
    drops = [Drop("tracks", "two places of one photo in one track", statistics.dropped_conflicting)]
    model = WorkingModel.start(tuple(cameras), camera_of_image, tracks)
    initial = choose_initial_pair(graph, cameras, camera_of_image, options)
    if initial is None:
        verdicts = dict.fromkeys(graph.names, "not registered: no pair of photos with enough matches and parallax")
        return MappingRun(to_reconstruction(model, graph), graph, None, (), tuple(drops), None, verdicts)

    i, j = initial.pair
    model = model.with_pose(i, Rigid3.identity()).with_pose(j, initial.candidates[initial.chosen])
    model, records = triangulate_new_points(model, graph.names, (i, j), options.robust_scale_px)
    model, dropped = drop_outliers(model, "start", options.max_error_px, options.min_angle_deg)
    drops += dropped
    model, failures, more_records, dropped = register_all(model, graph, options, seed, on_progress)
    records, drops = records + more_records, drops + dropped
    records += record_views(model, graph.names, "before BA")
    before = to_reconstruction(model, graph)
    model, dropped = refine_globally(model, options)
    records += record_views(model, graph.names, "after BA")
    verdicts = _verdicts(graph, model, failures)
    reconstruction = to_reconstruction(model, graph)
    return MappingRun(reconstruction, graph, initial, tuple(records), tuple(drops + dropped), before, verdicts)


def register_all(
    model: WorkingModel, graph: MatchGraph, options: TextbookOptions, seed: int, on_progress: OnProgress = silent
) -> tuple[WorkingModel, dict[int, str], list[StageRecord], list[Drop]]:
    """Photo after photo, until none that is left can be registered; the failures say why not."""
    progress = StageProgress(on_progress, "registering photos", graph.num_images)
    progress.at(model.num_registered)
    records: list[StageRecord] = []
    drops: list[Drop] = []
    failures: dict[int, str] = {}
    while (view := view_with_most_points(model, failures)) is not None:
        if not failures:  # the model has grown since the last adjustment
            model = adjust_with_scipy(model, options, refine_focal=False)
        pose, reason, stage_records = resect_view(model, graph, view, options, seed)
        records += stage_records
        if pose is None:
            failures[view] = reason
            continue
        logger.info("registered %s: %s", graph.names[view], reason)
        failures.clear()  # a larger model may see what a smaller one could not
        model = model.with_pose(view, pose)
        progress.at(model.num_registered)
        model, stage_records = triangulate_new_points(model, graph.names, (view,), options.robust_scale_px)
        records += stage_records
        model, dropped = drop_outliers(model, f"after {graph.names[view]}", options.max_error_px, options.min_angle_deg)
        drops += dropped
    return model, failures, records, drops


def estimate_essential_matrices(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    options: TextbookOptions,
    seed: int,
) -> MatchGraph:
    """The graph with the essential matrix and the inliers of every pair; pairs with too few inliers have none.

    The random numbers of pair (i, j) depend on the seed, i and j alone.
    """
    two_views = {}
    for i, j in sorted(graph.matches):
        pixels1, pixels2 = graph.matched_pixels((i, j))
        result = ransac(FundamentalEstimator(pixels1, pixels2), options.two_view, np.random.default_rng([seed, i, j]))
        inliers = np.zeros(len(pixels1), dtype=bool) if result is None else result.inliers
        if result is None or inliers.sum() < options.min_pair_inliers:
            two_views[i, j] = TwoView("degenerate", np.zeros((3, 3)), None, np.zeros_like(inliers))
            logger.info("pair %s - %s: %d matches, no geometry", graph.names[i], graph.names[j], len(inliers))
            continue
        camera1, camera2 = cameras[camera_of_image[i]], cameras[camera_of_image[j]]
        E = essential_from_fundamental(result.model, camera1.calibration_matrix(), camera2.calibration_matrix())
        two_views[i, j] = TwoView("calibrated", E, None, inliers)
        logger.info(
            "pair %s - %s: %d of %d matches after %d trials",
            graph.names[i], graph.names[j], inliers.sum(), len(inliers), result.num_trials,
        )  # fmt: skip
    return graph.with_two_views(two_views)


def choose_initial_pair(
    graph: MatchGraph, cameras: Sequence[Camera], camera_of_image: Int[np.ndarray, "n"], options: TextbookOptions
) -> InitialPair | None:
    """The pair with the largest number of inliers times the sine of their median triangulation angle.

    Many matches make a stable pose, wide rays make stable points; a pair needs both. Angles beyond 30 deg gain
    nothing more. Pairs below `min_angle_deg` are no start.
    """
    best_score, best = 0.0, None
    for pair in sorted(graph.two_views):
        if graph.two_views[pair].kind != "calibrated":
            continue
        start = four_poses(graph, pair, cameras, camera_of_image)
        angle = _median_angle(start)
        if angle < np.deg2rad(options.min_angle_deg) or start.in_front[start.chosen] < options.min_pair_inliers:
            continue
        score = float(start.in_front[start.chosen] * np.sin(min(angle, np.deg2rad(30.0))))
        if score > best_score:
            best_score, best = score, start
    return best


def four_poses(
    graph: MatchGraph, pair: ImagePair, cameras: Sequence[Camera], camera_of_image: Int[np.ndarray, "n"]
) -> InitialPair:
    """The four poses of a pair's essential matrix, and the one that cheirality chooses."""
    pixels1, pixels2 = graph.matched_pixels(pair, graph.inlier_matches(pair))
    uv1 = plane_from_image(cameras[camera_of_image[pair[0]]], pixels1)
    uv2 = plane_from_image(cameras[camera_of_image[pair[1]]], pixels2)
    two_view = graph.two_views[pair]
    known = two_view.cam2_from_cam1
    candidates = poses_from_essential(two_view.matrix if known is None else essential_from_pose(known))
    chosen, in_front = choose_by_cheirality(candidates, uv1, uv2)
    points = tuple(
        triangulate_linear(Rigid3.stack([Rigid3.identity(), pose]), np.stack([uv1, uv2], axis=1)) for pose in candidates
    )
    return InitialPair(pair, tuple(candidates), in_front, chosen, points)


def view_with_most_points(model: WorkingModel, failures: dict[int, str]) -> int | None:
    """The photo without pose that sees most points of the model; None when none is left to try."""
    seen = model.visible_points_per_view()
    waiting = [v for v in np.flatnonzero(~model.registered & (seen > 0)).tolist() if v not in failures]
    return max(waiting, key=lambda v: (seen[v], -v), default=None)


def resect_view(
    model: WorkingModel, graph: MatchGraph, view: int, options: TextbookOptions, seed: int
) -> tuple[Rigid3 | None, str, list[StageRecord]]:
    """Pose of one more photo from the points that it sees, with the reprojections of every stage.

    Linear PnP of all correspondences is recorded for comparison only: one false correspondence spoils it.
    """
    camera, name = model.camera_of(view), graph.names[view]
    rows = model.observations_of(view)
    pixels, points = model.tracks.pixels[rows], model.xyz[model.tracks.point[rows]]
    if len(rows) < options.min_registration_inliers:
        return None, f"not registered: sees {len(rows)} points of the model", []

    def recorded(stage: str, pose: Rigid3, keep: slice | np.ndarray) -> StageRecord:
        return StageRecord(stage, view, name, pixels[keep], image_from_cam(camera, pose.apply(points[keep])))

    records = []
    linear = pnp_linear(plane_from_image(camera, pixels), points)
    if np.all(np.isfinite(linear)):
        records.append(recorded("linear PnP", pose_from_matrix(linear), slice(None)))
    estimator = PnpEstimator(camera, pixels, points)
    result = ransac(estimator, options.pnp, np.random.default_rng([seed, model.num_views, view]))
    if result is None or result.inliers.sum() < options.min_registration_inliers:
        count = 0 if result is None else int(result.inliers.sum())
        return None, f"not registered: {count} of {len(rows)} points agree with one pose", records
    pose = pose_from_matrix(result.model)
    records.append(recorded("PnP RANSAC", pose, result.inliers))
    loss = soft_l1(options.robust_scale_px)
    pose = pnp_nonlinear(camera, pose, pixels[result.inliers], points[result.inliers], loss=loss)
    records.append(recorded("non-linear PnP", pose, result.inliers))
    return pose, f"{int(result.inliers.sum())} of {len(rows)} points agree with one pose", records


def adjust_with_scipy(model: WorkingModel, options: TextbookOptions, *, refine_focal: bool) -> WorkingModel:
    """Bundle adjustment of all poses and points; the first registered view fixes the frame."""
    registered = np.flatnonzero(model.registered).tolist()
    rows = model.used_observations()
    used_points, point = np.unique(model.tracks.point[rows], return_inverse=True)
    view = np.searchsorted(registered, model.tracks.view[rows])
    refine = tuple(np.arange(len(c.params)) < (c.spec.num_focal if refine_focal else 0) for c in model.cameras)
    problem = BundleProblem(
        cameras=model.cameras,
        camera_of_view=model.camera_of_view[registered],
        cam_from_world=model.cam_from_world[registered],
        points=model.xyz[used_points],
        view=view,
        point=point,
        pixels=model.tracks.pixels[rows],
        fixed_views=np.arange(len(registered)) == 0,
        fixed_points=np.zeros(len(used_points), dtype=bool),
        refine=refine,
    )
    result = bundle_adjust_scipy(problem, loss=soft_l1(options.robust_scale_px))
    logger.info("bundle adjustment: cost %.1f -> %.1f, %s", result.initial_cost, result.final_cost, result.reason)
    return model.with_adjusted(result.problem, registered, used_points)


def refine_globally(model: WorkingModel, options: TextbookOptions) -> tuple[WorkingModel, list[Drop]]:
    """Rounds of bundle adjustment, dropping what does not fit and recalling what fits again, until nothing changes."""
    drops: list[Drop] = []
    for round_number in range(options.max_rounds):
        model = adjust_with_scipy(model, options, refine_focal=options.refine_focal)
        before = model.active.copy()
        model = recall_observations(model, options.max_error_px)
        model, dropped = drop_outliers(
            model, f"final round {round_number + 1}", options.max_error_px, options.min_angle_deg
        )
        drops += dropped
        if np.mean(before != model.active) < 5e-4:
            break
    return model, drops


def _median_angle(start: InitialPair) -> float:
    """Median triangulation angle of the points that the chosen pose puts in front of both cameras."""
    pose, points = start.candidates[start.chosen], start.points[start.chosen]
    finite = points[np.all(np.isfinite(points), axis=1)]
    ahead = finite[(finite[:, 2] > 0) & (pose.apply(finite)[:, 2] > 0)]
    if not len(ahead):
        return 0.0
    return float(np.median(triangulation_angles(np.zeros(3), pose.target_origin_in_source(), ahead)))


def _verdicts(graph: MatchGraph, model: WorkingModel, failures: dict[int, str]) -> dict[str, str]:
    """For every photo: registered with so many points, or why not."""
    out, errors = {}, reprojections(model)
    counts = np.bincount(model.tracks.view[errors.rows], minlength=model.num_views)
    for view, name in enumerate(graph.names):
        if model.registered[view]:
            out[name] = f"registered: {counts[view]} points"
        else:
            out[name] = failures.get(view, "not registered: sees no point of the model")
    return out
