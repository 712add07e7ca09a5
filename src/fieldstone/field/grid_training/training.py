"""Training of the grid field: stages of growing resolution, steps that give the same bytes on any number of threads.

A step has three parts, each split into a fixed number of pieces that any number of threads may take: chunks of rays
(gradients), halves of levels (adding them up), ranges of the table (stepping it). Between steps, at those that the
schedule says, cells are given up, poses refined and grids grown.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, StepReport, in_world
from fieldstone.field.base.ray_dataset import poses_in_frame
from fieldstone.field.base.space import Space
from fieldstone.field.evidence.options import DEFAULT_EVIDENCE, FloaterOptions
from fieldstone.field.evidence.pose_refinement import RefinablePoses, at_surfaces, refined
from fieldstone.field.grid.decoder import HIDDEN, Decoder, decoder_width, initial_decoder
from fieldstone.field.grid.exposure import gains_of, step_exposure, unit_exposure
from fieldstone.field.grid.field import FOREVER, REFERENCE_CELLS, GridField, clear_unreachable
from fieldstone.field.grid.layout import CHANNELS, grid_layout
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.field.grid.rays import RayTable
from fieldstone.field.grid.render import renderer
from fieldstone.field.grid.step_numba import Draw, Model, RaySources, chunk_step
from fieldstone.field.grid.terms_numba import SparseDepths
from fieldstone.field.grid_training.buffers import RAYS_PER_DEPTH_RAY, step_buffers
from fieldstone.field.grid_training.plan import GridPlan
from fieldstone.field.grid_training.pruning import cell_size_for, without_empty_cells, without_floating_cells
from fieldstone.field.grid_training.state import (
    GridState,
    claim,
    grown,
    next_rays,
    state_from_tensors,
    state_to_tensors,
    stepped,
)
from fieldstone.field.grid_training.update import step_decoder, step_grid

logger = logging.getLogger(__name__)

POSE_STEPS = 3
"""Steps of every photo each time that poses are refined."""

POSES_AT = (2, 3, 4, 5, 6)
"""Stages that begin with refined poses, if the plan has them: what coarse grids show is too blurred to tell."""

INITIAL_WEIGHT_RATIO = 1.2
"""The initial density weighs at least this many times `Sampling.min_weight` in every sample."""

INITIAL_DENSITY_RATIO = 1.2
"""Cells with less than this many times the initial density are what no ray has asked for."""

NEAR_FRACTION = 0.5
"""In a contracted space, rays begin at this fraction of the nearest distance of the frame."""


class ChunkResult(NamedTuple):
    """What a chunk found; its gradients lie in its buffers."""

    rays: int
    samples: int
    evaluations: int
    """Density evaluations."""
    squared_error: float


@dataclass(frozen=True, eq=False)
class GridTraining:
    """Trains a grid field on a table of rays; a `FieldTraining`. Made by `prepare_grid_training`."""

    rays: RayTable
    depth_rays: RayTable
    """Rays to triangulated points; may be none."""
    sparse_depths: SparseDepths
    """Where those points lie on their rays."""
    frame: FieldFrame
    occupancy: Occupancy
    """Where something may be, before training."""
    space: Space
    plan: GridPlan
    seed: int
    executor: Executor
    points_in_grid: Float[np.ndarray, "p 3"]
    """All triangulated points."""
    alpha_known: bool
    """Photos say themselves where they show the background."""
    floaters: FloaterOptions = DEFAULT_EVIDENCE.floaters
    """What counts as hanging in the air."""
    refinable: RefinablePoses | None = None
    """The photos whose poses may be refined; None, if they may not."""

    @property
    def num_images(self) -> int:
        """Number of training photos."""
        return len(self.rays.centers)

    def start(self) -> GridState:
        """The state before the first step."""
        return self._first_state(self.plan, self.occupancy, stage=0, steps_done=0)

    def advance(self, state: GridState, /) -> tuple[GridState, StepReport]:
        """One step, in place: `state` is given away. Grids and occupancy change at the steps that the plan says.

        Raises:
            ValueError: The state was stepped before.
        """
        claim(state)
        state = self.scheduled(state)
        multiplier = state.plan.rate_multiplier(state.step)
        found = self._gradients(state, multiplier)
        rays = np.array([chunk.rays for chunk in found], dtype=np.int64)
        samples = np.array([chunk.samples for chunk in found], dtype=np.int64)
        self._move(state, samples, multiplier)
        mse = sum(chunk.squared_error for chunk in found) / (3.0 * max(int(rays.sum()), 1))
        fitting = next_rays(
            np.maximum(rays - self.num_depth_rays(state), 1), samples, state.plan.sampling.samples_per_chunk
        )
        state = stepped(state, cursor=state.cursor + int(state.chunk_rays.sum()), chunk_rays=fitting)
        return state, StepReport(loss=mse, mse=mse)

    def num_depth_rays(self, state: GridState) -> Int[np.ndarray, "c"]:
        """Rays to triangulated points that each chunk draws."""
        use = state.plan.losses.sparse_depth_weight > 0 and len(self.depth_rays.image) > 0
        return state.chunk_rays // RAYS_PER_DEPTH_RAY * int(use)

    def is_due(self, state: GridState) -> bool:
        """Whether grids, occupancy or poses change before the next step, see `scheduled`."""
        grows = self._levels_now(state) != state.field.layout.resolutions
        prunes = state.plan.schedule.prunes_at(state.step)
        return self._ends_warm_up(state) or grows or prunes or self._refines_poses(state)

    def scheduled(self, state: GridState) -> GridState:
        """The state with what the schedule changes before the next step."""
        if state.plan.schedule.prunes_at(state.step):
            state = self._pruned(state)
        if self._ends_warm_up(state):
            return self._begun_again(state)
        if self.refinable is not None and self._refines_poses(state):
            state = self._with_refined_poses(state, self.refinable)
        levels = self._levels_now(state)
        return state if levels == state.field.layout.resolutions else grown(state, levels, self.num_images)

    def to_tensors(self, state: GridState, /) -> dict[str, np.ndarray]:
        """The field, and what resuming needs besides."""
        return state_to_tensors(state)

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> GridState:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        try:
            rays, depth_rays = self._rays_from(tensors["moved"])
            return state_from_tensors(tensors, rays, depth_rays, self.num_images)
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"this checkpoint cannot be resumed ({error}); delete it and train again") from error

    def renderer(self, state: GridState, /) -> RayRenderer:
        """Renders rays in normalised coordinates with the field as it is now."""
        return renderer(state.field, self.frame, self.executor)

    # One step

    def _gradients(self, state: GridState, multiplier: float) -> Sequence[ChunkResult]:
        """Run every chunk forwards and backwards; gradients are left in the buffers."""
        field, buffers = state.field, state.buffers
        transposed = np.ascontiguousarray(field.decoder.feature_weights.reshape(-1, HIDDEN).T).reshape(-1)
        model = Model(buffers.grid, buffers.box, buffers.march, field.decoder, transposed, field.width)
        sources = RaySources(
            table=state.rays,
            depth_rays=state.depth_rays,
            sparse_depths=self.sparse_depths,
            gains=gains_of(state.exposure),
            background=self.frame.background.astype(np.float32),
            seed=self.seed,
        )
        terms = state.plan.losses.terms(multiplier, alpha_known=self.alpha_known)
        starts = (state.cursor + np.cumsum(state.chunk_rays) - state.chunk_rays).tolist()
        counts, depth_counts = state.chunk_rays.tolist(), self.num_depth_rays(state).tolist()

        def run(c: int) -> ChunkResult:
            draw = Draw(starts[c], counts[c], starts[c] // RAYS_PER_DEPTH_RAY, depth_counts[c])
            found: tuple[int, int, int, float] = chunk_step(model, sources, draw, terms, FOREVER, buffers.chunks[c])
            return ChunkResult(*found)

        return list(self.executor.map(run, range(len(buffers.chunks))))

    def _move(self, state: GridState, samples: Int[np.ndarray, "c"], multiplier: float) -> None:
        """Step grids, decoder and exposures in place with the gradients of all chunks."""
        chunks = state.buffers.chunks
        step_grid(state, samples, multiplier, self.executor)
        step_decoder(state, [chunk.gradient for chunk in chunks], multiplier)
        rate = state.plan.rates.exposure_rate * multiplier
        if rate > 0:
            step_exposure(state.exposure, [chunk.gain_gradient for chunk in chunks], state.step + 1, rate)

    # Between steps

    def _first_state(self, plan: GridPlan, occupancy: Occupancy, *, stage: int, steps_done: int) -> GridState:
        """A state that knows nothing but where something may be, on the grids of a stage."""
        rng = np.random.default_rng([self.seed, 1, stage])
        decoder = initial_decoder(decoder_width(len(plan.schedule.levels(len(plan.schedule.steps) - 1))), rng)
        layout = grid_layout(occupancy.extent, plan.schedule.levels(stage))
        table = np.zeros(layout.num_values, dtype=np.float32)
        for level in range(layout.num_levels):
            vertices = layout.level(table, level)
            vertices[..., 1:] = rng.uniform(-0.01, 0.01, (*vertices.shape[:3], CHANNELS - 1))
        field = GridField(
            layout=layout,
            table=table,
            decoder=decoder,
            occupancy=occupancy,
            density_bias=_visible_density_bias(plan, layout.resolutions[-1]),
            step_cells=plan.sampling.step_cells,
            near=NEAR_FRACTION * self.frame.near if self.space.is_contracted else 0.0,
            space=self.space,
        )
        return GridState(
            plan=plan,
            step=steps_done,
            cursor=0,
            chunk_rays=np.full(plan.sampling.num_chunks, plan.sampling.samples_per_chunk // 8, dtype=np.int64),
            field=field,
            mean_square=np.zeros_like(table),
            decoder_first_moment=Decoder(*(np.zeros_like(weights) for weights in decoder)),
            decoder_second_moment=Decoder(*(np.zeros_like(weights) for weights in decoder)),
            exposure=unit_exposure(self.num_images),
            pose_deltas=np.zeros((self.num_images, 6)),
            rays=self.rays,
            depth_rays=self.depth_rays,
            buffers=step_buffers(field, plan, self.num_images, steps_done),
        )

    def _levels_now(self, state: GridState) -> tuple[int, ...]:
        return state.plan.schedule.levels(state.plan.schedule.stage_of(state.step))

    def _ends_warm_up(self, state: GridState) -> bool:
        """The box around the scene was found, and training begins again in it."""
        return state.plan.schedule.box_warm_up and state.plan.schedule.place(state.step) == (1, 0)

    def _refines_poses(self, state: GridState) -> bool:
        stage, into_stage = state.plan.schedule.place(state.step)
        return state.plan.schedule.refine_poses and bool(self.refinable) and into_stage == 0 and stage in POSES_AT

    def _begun_again(self, state: GridState) -> GridState:
        occupancy = state.field.occupancy.trimmed()
        begun = self._first_state(state.plan, occupancy, stage=1, steps_done=state.step)
        return replace(begun, cursor=state.cursor)

    def _pruned(self, state: GridState) -> GridState:
        """Without cells that are nowhere dense, and from some stage on without what hangs in the air."""
        schedule, field = state.plan.schedule, state.field
        stage, into_stage = schedule.place(state.step)
        if cell_size_for(field) != field.occupancy.cell_size:
            # Cells of another size may reach vertices that had been given up.
            clear_unreachable(field, field.table, state.mean_square)
        initial = INITIAL_DENSITY_RATIO * math.exp(field.density_bias)
        threshold = initial if stage >= schedule.clear_initial_density_from else 0.0
        field = without_empty_cells(field, max(schedule.prune_density, threshold), self.executor)
        if schedule.clear_floaters_from <= stage and into_stage == 0 and len(self.points_in_grid):
            field = without_floating_cells(field, self.points_in_grid, self.floaters, self.executor)
        return replace(state, field=field, buffers=replace(state.buffers, box=field.box()))

    def _with_refined_poses(self, state: GridState, refinable: RefinablePoses) -> GridState:
        gains = gains_of(state.exposure).astype(np.float64).reshape(-1, 3)
        scale = self.frame.normalized_from_world.scale
        render_rays = at_surfaces(in_world(self.renderer(state), self.frame), self.frame.far / scale)
        deltas = state.pose_deltas
        for _ in range(POSE_STEPS):
            deltas = refined(refinable, deltas, render_rays, gains, self.frame.background)
        rotated_deg = np.rad2deg(np.linalg.norm(deltas[:, :3], axis=1))
        logger.info("poses refined: rotated by %.4f deg in the median", np.median(rotated_deg))
        rays, depth_rays = self._rays_from(deltas)
        return replace(state, pose_deltas=deltas, rays=rays, depth_rays=depth_rays)

    def _rays_from(self, pose_deltas: Float[np.ndarray, "v 6"]) -> tuple[RayTable, RayTable]:
        """All rays and those to points, with the photos at refined poses; which pixels there are stays."""
        if self.refinable is None or not pose_deltas.any():
            return self.rays, self.depth_rays
        refined_poses = self.refinable.photos.posed.cam_from_world.retract(pose_deltas)
        rotations, centers = poses_in_frame(refined_poses, self.frame)
        rays, depth_rays = (t._replace(rotations=rotations, centers=centers) for t in (self.rays, self.depth_rays))
        return rays, depth_rays


def _visible_density_bias(plan: GridPlan, finest: int) -> float:
    """The log density of the start: that of the plan, or more where a step would take it for empty.

    A density that no sample weighs teaches nothing: a fine grid, whose steps are short, has to start denser.
    """
    sampling = plan.sampling
    visible = INITIAL_WEIGHT_RATIO * sampling.min_weight / (sampling.step_cells * REFERENCE_CELLS / finest)
    return max(sampling.density_bias, math.log(visible))
