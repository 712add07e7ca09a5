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

    An infinite sigma leaves only the bounds. The prior weighs as much as one residual of sigma 1 px.
    """

    camera: int
    param: int
    """Index in `Camera.params`."""
    mean: float = 0.0
    sigma: float = np.inf
    lower: float = -np.inf
    upper: float = np.inf

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

    def cost(self, params: Float[np.ndarray, "c 12"]) -> float:
        """0.5 sum ((x - mean) / sigma)^2."""
        offset = params[self.camera, self.param] - self.mean
        return 0.5 * float(np.sum(self.weight * offset * offset))


def prior_rows(problem: BundleProblem, layout: BundleLayout, priors: tuple[CameraPrior, ...]) -> PriorRows:
    """Find the column of every prior's parameter; priors of held or unseen parameters say nothing.

    Raises:
        ValueError: A prior names a camera or parameter that does not exist, or the start is outside its bounds.
    """
    rows: list[tuple[int, int, CameraPrior, int, int]] = []
    view_of_camera = free_view_of_camera(layout)
    for prior in priors:
        if not 0 <= prior.camera < len(problem.cameras):
            raise ValueError(f"a prior names camera {prior.camera}, there are {len(problem.cameras)}")
        camera = problem.cameras[prior.camera]
        if not 0 <= prior.param < len(camera.params):
            raise ValueError(f"a prior names parameter {prior.param}, camera {prior.camera} has {len(camera.params)}")
        if not problem.refine[prior.camera][prior.param]:
            continue
        if not prior.lower <= camera.params[prior.param] <= prior.upper:
            raise ValueError(
                f"camera {prior.camera} starts with {camera.spec.param_names[prior.param]} = "
                f"{camera.params[prior.param]}, outside its bounds [{prior.lower}, {prior.upper}]"
            )
        k = int(np.flatnonzero(layout.refined[prior.camera] == prior.param)[0])
        if layout.per_view[prior.camera]:
            rows.append((k, prior.camera, prior, view_of_camera[prior.camera], 6 + k))
        elif layout.shared_row[prior.camera] >= 0:
            rows.append((k, prior.camera, prior, -1, int(layout.shared_row[prior.camera]) + k))
    return PriorRows(
        camera=np.array([c for _, c, _, _, _ in rows], dtype=np.int64),
        param=np.array([prior.param for _, _, prior, _, _ in rows], dtype=np.int64),
        refined_index=np.array([k for k, _, _, _, _ in rows], dtype=np.int64),
        mean=np.array([prior.mean for _, _, prior, _, _ in rows], dtype=np.float64),
        weight=np.array([prior.sigma**-2.0 for _, _, prior, _, _ in rows], dtype=np.float64),
        lower=np.array([prior.lower for _, _, prior, _, _ in rows], dtype=np.float64),
        upper=np.array([prior.upper for _, _, prior, _, _ in rows], dtype=np.float64),
        free_view=np.array([view for _, _, _, view, _ in rows], dtype=np.int64),
        column=np.array([column for _, _, _, _, column in rows], dtype=np.int64),
    )


def add_priors(rows: PriorRows, params: Float[np.ndarray, "c 12"], system: CameraSystem) -> None:
    """Add the priors' normal equations to those of the cameras."""
    gradient = rows.weight * (params[rows.camera, rows.param] - rows.mean)
    per_view, shared = rows.free_view >= 0, rows.free_view < 0
    np.add.at(system.U, (rows.free_view[per_view], rows.column[per_view], rows.column[per_view]), rows.weight[per_view])
    np.add.at(system.g, (rows.free_view[per_view], rows.column[per_view]), gradient[per_view])
    np.add.at(system.corner, (rows.column[shared], rows.column[shared]), rows.weight[shared])
    np.add.at(system.g_shared, rows.column[shared], gradient[shared])


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
    """Identity rows for held parameters, whose columns are zero already: their step is 0."""
    per_view, shared = held & (rows.free_view >= 0), held & (rows.free_view < 0)
    system.U[rows.free_view[per_view], rows.column[per_view], rows.column[per_view]] = 1.0
    system.g[rows.free_view[per_view], rows.column[per_view]] = 0.0
    system.corner[rows.column[shared], rows.column[shared]] = 1.0
    system.g_shared[rows.column[shared]] = 0.0


def clip_to_bounds(rows: PriorRows, params: Float[np.ndarray, "c 12"]) -> None:
    """Move parameters that a step carried outside their bounds onto them, in place."""
    params[rows.camera, rows.param] = np.clip(params[rows.camera, rows.param], rows.lower, rows.upper)
