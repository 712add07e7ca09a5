"""What is known of a camera's intrinsics before bundle adjustment: Gaussian priors and bounds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.solve.bundle.buffers import CameraSystem, Linearization
from fieldstone.solve.bundle.layout import BundleLayout, free_view_of_camera
from fieldstone.solve.bundle.problem import BundleProblem


@dataclass(frozen=True)
class CameraPrior:
    """One parameter of one camera: it is about `mean`, give or take `sigma`, and stays in [lower, upper].

    An infinite sigma leaves only the bounds. The prior weighs as much as one residual of sigma 1 px. With `of`, the
    Gaussian is about `ratio` times that other parameter, plus `mean`; the bounds are of the parameter itself.
    """

    camera: int
    param: int
    """Index in `Camera.params`."""
    mean: float = 0.0
    sigma: float = np.inf
    lower: float = -np.inf
    upper: float = np.inf
    of: int | None = None
    """Index of another parameter of the camera that is free too."""
    ratio: float = 1.0

    def __post_init__(self) -> None:
        if not self.sigma > 0:
            raise ValueError(f"sigma of a camera prior must be positive, got {self.sigma}")
        if not self.lower <= self.upper:
            raise ValueError(f"bounds of a camera prior are empty: [{self.lower}, {self.upper}]")


@dataclass(frozen=True, eq=False)
class PriorRows:
    """Priors of free parameters as arrays.

    A parameter stands in a column of the block of a free view or, where that view is -1, among shared intrinsics.
    """

    camera: Int[np.ndarray, "n"]
    param: Int[np.ndarray, "n"]
    refined_index: Int[np.ndarray, "n"]
    mean: Float[np.ndarray, "n"]
    weight: Float[np.ndarray, "n"]
    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]
    free_view: Int[np.ndarray, "n"]
    column: Int[np.ndarray, "n"]
    other_param: Int[np.ndarray, "n"]
    other_column: Int[np.ndarray, "n"]
    ratio: Float[np.ndarray, "n"]
    """0 where the prior is of one parameter only; the other is then any one."""

    def offset(self, params: Float[np.ndarray, "c 12"]) -> Float[np.ndarray, "n"]:
        """x - ratio y - mean."""
        return params[self.camera, self.param] - self.ratio * params[self.camera, self.other_param] - self.mean

    def cost(self, params: Float[np.ndarray, "c 12"]) -> float:
        """0.5 sum (offset / sigma)^2."""
        return 0.5 * float(np.sum(self.weight * self.offset(params) ** 2))


def prior_rows(problem: BundleProblem, layout: BundleLayout, priors: tuple[CameraPrior, ...]) -> PriorRows:
    """Find the column of every prior's parameter; priors of held or unseen parameters say nothing.

    Raises:
        ValueError: A prior names a camera or parameter that does not exist, or the start is outside its bounds.
    """
    rows: list[tuple[int, int, CameraPrior, int, int, int]] = []
    view_of_camera = free_view_of_camera(layout)
    for prior in priors:
        _check(prior, problem)
        free = problem.refine[prior.camera]
        if not free[prior.param] or (prior.of is not None and not free[prior.of]):
            continue
        k, other = (
            int(np.flatnonzero(layout.refined[prior.camera] == param)[0])
            for param in (prior.param, prior.param if prior.of is None else prior.of)
        )
        if layout.per_view[prior.camera]:
            view, first = view_of_camera[prior.camera], 6
        elif layout.shared_row[prior.camera] >= 0:
            view, first = -1, int(layout.shared_row[prior.camera])
        else:
            continue
        rows.append((k, prior.camera, prior, view, first + k, first + other))
    coupled = [prior.of is not None for _, _, prior, *_ in rows]
    return PriorRows(
        camera=np.array([c for _, c, *_ in rows], dtype=np.int64),
        param=np.array([prior.param for _, _, prior, *_ in rows], dtype=np.int64),
        refined_index=np.array([k for k, *_ in rows], dtype=np.int64),
        mean=np.array([prior.mean for _, _, prior, *_ in rows], dtype=np.float64),
        weight=np.array([prior.sigma**-2.0 for _, _, prior, *_ in rows], dtype=np.float64),
        lower=np.array([prior.lower for _, _, prior, *_ in rows], dtype=np.float64),
        upper=np.array([prior.upper for _, _, prior, *_ in rows], dtype=np.float64),
        free_view=np.array([view for *_, view, _, _ in rows], dtype=np.int64),
        column=np.array([column for *_, column, _ in rows], dtype=np.int64),
        other_param=np.array([p.param if p.of is None else p.of for _, _, p, *_ in rows], dtype=np.int64),
        other_column=np.array([other for *_, other in rows], dtype=np.int64),
        ratio=np.array([p.ratio for _, _, p, *_ in rows], dtype=np.float64) * np.array(coupled, dtype=np.float64),
    )


def _check(prior: CameraPrior, problem: BundleProblem) -> None:
    """Raise where a prior names what does not exist, or a free parameter starts outside its bounds."""
    if not 0 <= prior.camera < len(problem.cameras):
        raise ValueError(f"a prior names camera {prior.camera}, there are {len(problem.cameras)}")
    camera = problem.cameras[prior.camera]
    for param in (prior.param, *(() if prior.of is None else (prior.of,))):
        if not 0 <= param < len(camera.params):
            raise ValueError(f"a prior names parameter {param}, camera {prior.camera} has {len(camera.params)}")
    start = camera.params[prior.param]
    if problem.refine[prior.camera][prior.param] and not prior.lower <= start <= prior.upper:
        raise ValueError(
            f"camera {prior.camera} starts with {camera.spec.param_names[prior.param]} = "
            f"{start}, outside its bounds [{prior.lower}, {prior.upper}]"
        )


def add_priors(rows: PriorRows, params: Float[np.ndarray, "c 12"], system: CameraSystem) -> None:
    """Add the priors' normal equations to those of the cameras: J = (1, -ratio)."""
    offset = rows.weight * rows.offset(params)
    x, y, view, shared = rows.column, rows.other_column, rows.free_view, rows.free_view < 0
    slope = -rows.ratio
    for a, b, factor in ((x, x, 1.0), (x, y, slope), (y, x, slope), (y, y, slope**2)):
        value = factor * rows.weight
        np.add.at(system.U, (view[~shared], a[~shared], b[~shared]), value[~shared])
        np.add.at(system.corner, (a[shared], b[shared]), value[shared])
    for a, value in ((x, offset), (y, slope * offset)):
        np.add.at(system.g, (view[~shared], a[~shared]), value[~shared])
        np.add.at(system.g_shared, a[shared], value[shared])


def held_at_bounds(rows: PriorRows, params: Float[np.ndarray, "c 12"], system: CameraSystem) -> Bool[np.ndarray, "n"]:
    """Parameters that stand at a bound and that the gradient would carry past it."""
    value = params[rows.camera, rows.param]
    shared = rows.free_view < 0
    gradient = np.empty(len(value))
    gradient[shared] = system.g_shared[rows.column[shared]]
    gradient[~shared] = system.g[rows.free_view[~shared], rows.column[~shared]]
    return ((value <= rows.lower) & (gradient >= 0)) | ((value >= rows.upper) & (gradient <= 0))


def drop_columns(rows: PriorRows, held: Bool[np.ndarray, "n"], layout: BundleLayout, at: Linearization) -> None:
    """Zero the columns of held parameters in the Jacobian."""
    camera_of_obs = layout.camera_of_view[layout.view_of_obs]
    for i in np.flatnonzero(held):
        at.J_camera[camera_of_obs == rows.camera[i], :, rows.refined_index[i]] = 0.0


def pin(rows: PriorRows, held: Bool[np.ndarray, "n"], system: CameraSystem) -> None:
    """Identity rows for held parameters, whose columns are zero but for coupled priors: their step is 0."""
    per_view, shared = held & (rows.free_view >= 0), held & (rows.free_view < 0)
    for view, column in zip(rows.free_view[per_view], rows.column[per_view], strict=True):
        system.U[view, column, :] = system.U[view, :, column] = 0.0
    for column in rows.column[shared]:
        system.corner[column, :] = system.corner[:, column] = 0.0
    system.U[rows.free_view[per_view], rows.column[per_view], rows.column[per_view]] = 1.0
    system.g[rows.free_view[per_view], rows.column[per_view]] = 0.0
    system.corner[rows.column[shared], rows.column[shared]] = 1.0
    system.g_shared[rows.column[shared]] = 0.0


def clip_to_bounds(rows: PriorRows, params: Float[np.ndarray, "c 12"]) -> None:
    """Move parameters that a step carried outside their bounds onto them, in place."""
    params[rows.camera, rows.param] = np.clip(params[rows.camera, rows.param], rows.lower, rows.upper)
