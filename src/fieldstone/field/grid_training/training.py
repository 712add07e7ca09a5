"""Training of the fast field: stages of growing resolution, steps that give the same bytes on any number of threads.

A step has three parts, each split into a fixed number of pieces that any number of threads may take: chunks of rays
(gradients), halves of levels (adding them up), ranges of the table (moving it).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from fieldstone.errors import InputError
from fieldstone.field.base.projection import projection_for
from fieldstone.field.base.radiance_field import FieldFrame, RayRenderer, StepReport, in_world
from fieldstone.field.base.ray_dataset import NORMALIZED_RADIUS, PosedImage, SeenPoints, poses_in_frame
from fieldstone.field.base.space import Space, box_space, contracted_space, grid_from_normalized, projective_space
from fieldstone.field.evidence.floaters import without_floaters
from fieldstone.field.evidence.free_space import carve_free_space, probably_free
from fieldstone.field.evidence.pose_refinement import MovablePhoto, at_surfaces, movable_photos, moved_images, refined
from fieldstone.field.evidence.sparse_depth import known_rays, no_known_rays
from fieldstone.field.grid.decoder import HIDDEN, Decoder, decoder_width, initial_decoder
from fieldstone.field.grid.exposure import Exposure, gains_of, step_exposure, unit_exposure
from fieldstone.field.grid.field import (
    FOREVER,
    REFERENCE_CELLS,
    FastField,
    clear_unreachable,
    compress,
    expand,
    field_from_tensors,
    occupancy_box,
    reachable_vertices,
    renderer,
)  # fmt: skip
from fieldstone.field.grid.layout import CHANNELS, grid_layout
from fieldstone.field.grid.occupancy import Occupancy, full_box, visual_hull
from fieldstone.field.grid.occupancy_numba import used_cells
from fieldstone.field.grid.rays import RayTable, ray_table
from fieldstone.field.grid.step_numba import chunk_step
from fieldstone.field.grid.terms_numba import PointRays, Terms
from fieldstone.field.grid_training.buffers import RAYS_PER_KNOWN, Workspace, workspace
from fieldstone.field.grid_training.plan import FastPlan, plan_from_json
from fieldstone.field.grid_training.state import FastState, grown, next_rays
from fieldstone.field.grid_training.update import move_grid, step_decoder
from fieldstone.geometry.rigid3 import Rigid3

logger = logging.getLogger(__name__)

CELL_VERTICES = 2
"""An occupancy cell is this many cells of the finest level wide."""

SOLID = 0.1
"""A cell is solid where a step takes this optical depth."""

POSE_STEPS = 3
"""Steps of every photo at such a time."""

POSES_AT = (2, 3, 4, 5, 6)
"""Stages that begin with refined poses, if the plan has them: what coarse grids show is too blurred to tell."""

START_WEIGHTS = 1.2
"""The fog of the start weighs at least this many times `FastPlan.min_weight` in every sample."""

FOG = 1.2
"""Cells with less than this many times the density of the start are what no ray has asked for."""

NEAR_SHARE = 0.5
"""In a contracted space, rays begin at this share of the nearest distance of the frame."""

HULL_CELLS = 96
"""Cells of the visual hull along the longest side of the box."""

FREE_CELLS = 64
"""Cells of an open scene along the longest side, before training."""


@dataclass(frozen=True, eq=False)
class FastTraining:
    """Trains a fast field on a table of rays; a `FieldTraining`."""

    rays: RayTable
    known: RayTable
    """Rays to known points; may be none."""
    points: PointRays
    """Those points."""
    frame: FieldFrame
    occupancy: Occupancy
    """Where something may be, before training."""
    space: Space
    plan: FastPlan
    seed: int
    executor: Executor
    places: Float[np.ndarray, "p 3"]
    """Known points, in the grid."""
    alpha_known: bool
    """Photos say themselves where they show the background."""
    movable: tuple[MovablePhoto, ...] = ()
    """The photos whose poses may be refined; none, if they may not."""

    def start(self) -> FastState:
        """The state before the first step."""
        return self._first_state(self.plan, self.occupancy, stage=0)

    def _first_state(self, plan: FastPlan, occupancy: Occupancy, *, stage: int) -> FastState:
        """A state that knows nothing but where something may be, on the grids of a stage."""
        rng = np.random.default_rng([self.seed, 1, stage])
        decoder = initial_decoder(decoder_width(len(plan.levels(len(plan.steps) - 1))), rng)
        layout = grid_layout(occupancy.extent, plan.levels(stage))
        table = np.zeros(layout.num_values, dtype=np.float32)
        for level in range(layout.num_levels):
            vertices = layout.level(table, level)
            vertices[..., 1:] = rng.uniform(-0.01, 0.01, (*vertices.shape[:3], CHANNELS - 1))
        near = NEAR_SHARE * self.frame.near if self.space.is_contracted else 0.0
        # Fog that a step takes for empty teaches nothing: a fine grid, whose steps are short, has to start denser.
        visible = START_WEIGHTS * plan.min_weight / (plan.step_cells * REFERENCE_CELLS / layout.resolutions[-1])
        offset, step = max(plan.raw_offset, math.log(visible)), plan.step_cells
        field = FastField(layout, table, decoder, occupancy, offset, step, near, self.space)
        zeros = Decoder(*(np.zeros_like(weights) for weights in decoder))
        rays = np.full(plan.num_chunks, plan.samples_per_chunk // 8, dtype=np.int64)
        square = Decoder(*(np.zeros_like(weights) for weights in decoder))
        velocity, exposure = np.zeros_like(table), unit_exposure(self.num_images)
        moved = np.zeros((self.num_images, 6))
        room = self._workspace(field, plan)
        return FastState(plan, 0, 0, rays, field, velocity, zeros, square, exposure, moved, self.rays, self.known, room)

    @property
    def num_images(self) -> int:
        """Number of training photos."""
        return len(self.rays.centers)

    def _workspace(self, field: FastField, plan: FastPlan) -> Workspace:
        return workspace(field, plan, self.num_images)

    def step(self, state: FastState, /) -> tuple[FastState, StepReport]:
        """One step; grids and occupancy change at the steps that the plan says."""
        state = self.scheduled(state)
        plan = state.plan
        share = plan.rate_share(state.step)
        starts = state.cursor + np.concatenate([[0], np.cumsum(state.chunk_rays)])
        found = self._gradients(state, starts, share)
        counts = np.array([samples for _, samples, _, _ in found], dtype=np.int64)
        move_grid(state.field, state.velocity, plan, state.workspace, counts, share, self.executor)
        decoder, gradients = state.field.decoder, [chunk.gradient for chunk in state.workspace.chunks]
        moments = (state.decoder_mean, state.decoder_square)
        step_decoder(decoder, *moments, gradients, state.step + 1, np.float32(plan.decoder_rate * share))
        if plan.exposure_rate > 0:
            gradients = [chunk.gain_gradient for chunk in state.workspace.chunks]
            step_exposure(state.exposure, gradients, state.step + 1, plan.exposure_rate * share)
        rays = np.array([rays for rays, _, _, _ in found], dtype=np.int64)
        loss = sum(squared for _, _, _, squared in found)
        mse = loss / (3.0 * max(int(rays.sum()), 1))
        rays = np.maximum(rays - self.num_known(state), 1)
        state = replace(
            state,
            step=state.step + 1,
            cursor=int(starts[-1]),
            chunk_rays=next_rays(rays, counts, plan.samples_per_chunk),
        )
        return state, StepReport(loss=mse, mse=mse)

    def num_known(self, state: FastState) -> Int[np.ndarray, "c"]:
        """Rays to known points that each chunk draws."""
        use = state.plan.point_weight > 0 and len(self.known.image) > 0
        return state.chunk_rays // RAYS_PER_KNOWN * int(use)

    def _gradients(self, state: FastState, starts: np.ndarray, share: float) -> list[tuple[int, int, int, float]]:
        field, room, plan = state.field, state.workspace, state.plan
        transposed = np.ascontiguousarray(field.decoder.feature_weights.reshape(-1, HIDDEN).T).reshape(-1)
        background = self.frame.background.astype(np.float32)
        gains = gains_of(state.exposure)
        emptiness = 0.0 if self.alpha_known else plan.emptiness
        points, free = plan.point_weight * share, plan.free_weight
        terms = Terms(np.float32(plan.sparsity), np.float32(emptiness), np.float32(points), np.float32(free))
        num_known = self.num_known(state)

        def chunk(c: int) -> tuple[int, int, int, float]:
            return chunk_step(
                state.rays, int(starts[c]), int(state.chunk_rays[c]), state.known, self.points,
                int(starts[c]) // RAYS_PER_KNOWN, int(num_known[c]), gains, self.seed, background,
                room.grid, room.box, room.march, FOREVER, terms, field.decoder, transposed, field.width,
                room.chunks[c],
            )  # fmt: skip

        return list(self.executor.map(chunk, range(len(room.chunks))))

    def is_due(self, state: FastState) -> bool:
        """Whether grids or occupancy change before the next step, see `scheduled`."""
        stage, into_stage = state.plan.place(state.step)
        again = state.plan.scout and stage == 1 and into_stage == 0
        grows = state.plan.levels(stage) != state.field.layout.resolutions
        return again or grows or state.plan.prunes_at(state.step) or self._moves_photos(state)

    def scheduled(self, state: FastState) -> FastState:
        """Grow the grid at the first step of a stage, and give up empty cells when it is time."""
        plan = state.plan
        stage, into_stage = plan.place(state.step)
        if plan.prunes_at(state.step):
            if self._cell_size(state.field) != state.field.occupancy.cell_size:
                # Cells of another size may reach vertices that had been given up.
                clear_unreachable(state.field, state.field.table, state.velocity)
            fog = FOG * math.exp(state.field.raw_offset) if stage >= plan.clear_fog_from else 0.0
            field = self._pruned(state.field, max(plan.prune_density, fog))
            if plan.clear_floaters_from <= stage and into_stage == 0 and len(self.places):
                field = self._without_floaters(field)
            state = replace(state, field=field, workspace=replace(state.workspace, box=field.box()))
        if plan.scout and stage == 1 and into_stage == 0:
            found = self._first_state(plan, state.field.occupancy.trimmed(), stage=1)
            return replace(found, step=state.step, cursor=state.cursor)
        if self._moves_photos(state):
            state = self._with_refined_poses(state)
        wanted = plan.levels(stage)
        if wanted != state.field.layout.resolutions:
            state = grown(state, wanted, self.num_images)
        return state

    def _moves_photos(self, state: FastState) -> bool:
        stage, into_stage = state.plan.place(state.step)
        return state.plan.refine_poses and bool(self.movable) and into_stage == 0 and stage in POSES_AT

    def _with_refined_poses(self, state: FastState) -> FastState:
        gains = gains_of(state.exposure).astype(np.float64).reshape(-1, 3)
        scale = self.frame.normalized_from_world.scale
        render_rays = at_surfaces(in_world(self.renderer(state), self.frame), self.frame.far / scale)
        moved = state.moved
        for _ in range(POSE_STEPS):
            moved = refined(self.movable, moved, render_rays, gains, self.frame.background)
        turned_deg = np.rad2deg(np.linalg.norm(moved[:, :3], axis=1))
        logger.info("poses refined: turned by %.4f deg in the median", np.median(turned_deg))
        rays, known = self._rays_from(moved)
        return replace(state, moved=moved, rays=rays, known=known)

    def _rays_from(self, moved: Float[np.ndarray, "v 6"]) -> tuple[RayTable, RayTable]:
        """All rays and those to known points, with the photos at refined poses; which pixels there are stays."""
        if not self.movable or not moved.any():
            return self.rays, self.known
        images = moved_images([photo.image for photo in self.movable], moved)
        rotations, centers = poses_in_frame(images, self.frame)
        rays, known = (t._replace(rotations=rotations, centers=centers) for t in (self.rays, self.known))
        return rays, known

    def _cell_size(self, field: FastField) -> float:
        return min(float(field.layout.spacings[-1]) * CELL_VERTICES, field.occupancy.cell_size)

    def _pruned(self, field: FastField, density: float) -> FastField:
        """The field without the cells that are nowhere denser than `density`."""
        occupancy = field.occupancy.resampled(self._cell_size(field), field.layout.extent)
        cells = self._denser(field, occupancy, density)
        if not cells.any():
            return field
        logger.debug("occupied cells: %.2f %% of %s", 100.0 * cells.mean(), cells.shape)
        return replace(field, occupancy=replace(occupancy, cells=cells))

    def _without_floaters(self, field: FastField) -> FastField:
        solid = self._denser(field, field.occupancy, SOLID / field.step_depth)
        occupancy = without_floaters(field.occupancy, solid, self.places, self.space)
        cleared = np.count_nonzero(field.occupancy.cells) - np.count_nonzero(occupancy.cells)
        logger.debug("cleared %d cells around what hangs in the air", cleared)
        return replace(field, occupancy=occupancy)

    def _denser(self, field: FastField, occupancy: Occupancy, density: float) -> Bool[np.ndarray, "x y z"]:
        """Which occupied cells are denser than `density` somewhere."""
        spacing, cells = float(field.layout.spacings[-1]), occupancy.cells.copy()
        grid = field.layout.arrays(field.table)
        threshold = np.float32(math.log(density))
        pieces = np.linspace(0, len(cells), 17).astype(np.int64)

        def piece(n: int) -> None:
            used_cells(
                grid, cells, occupancy.cell_size, spacing, np.float32(field.raw_offset), threshold, pieces[n],
                pieces[n + 1],
            )  # fmt: skip

        list(self.executor.map(piece, range(16)))
        return cells

    def to_tensors(self, state: FastState, /) -> dict[str, np.ndarray]:
        """The field, and what resuming needs besides."""
        plan = state.plan
        reachable = reachable_vertices(state.field)
        tensors = state.field.to_tensors(reachable) | {
            "step": np.array(state.step, dtype=np.int64),
            "cursor": np.array(state.cursor, dtype=np.int64),
            "chunk_rays": state.chunk_rays,
            "moved": state.moved,
            "velocity": compress(state.field, state.velocity, reachable),
            "plan": np.frombuffer(plan.to_json().encode(), dtype=np.uint8).copy(),
        }
        for name in Decoder._fields:
            tensors[f"mean_{name}"] = getattr(state.decoder_mean, name)
            tensors[f"square_{name}"] = getattr(state.decoder_square, name)
        return tensors | {f"exposure_{name}": value for name, value in state.exposure._asdict().items()}

    def from_tensors(self, tensors: Mapping[str, np.ndarray], /) -> FastState:
        """The state of a checkpoint.

        Raises:
            InputError: An array is missing or has the wrong shape.
        """
        field = field_from_tensors(tensors)
        try:
            plan = plan_from_json(tensors["plan"].tobytes().decode())
            velocity = expand(field, tensors["velocity"]).table
            mean = Decoder(*(tensors[f"mean_{name}"].copy() for name in Decoder._fields))
            square = Decoder(*(tensors[f"square_{name}"].copy() for name in Decoder._fields))
            step, cursor = int(tensors["step"]), int(tensors["cursor"])
            rays = tensors["chunk_rays"].copy()
            exposure = Exposure(*(tensors[f"exposure_{name}"].copy() for name in Exposure._fields))
            moved = tensors["moved"].copy()
            return FastState(
                plan, step, cursor, rays, field, velocity, mean, square, exposure, moved, *self._rays_from(moved),
                self._workspace(field, plan),
            )  # fmt: skip
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"this checkpoint cannot be resumed ({error}); delete it and train again") from error

    def renderer(self, state: FastState, /) -> RayRenderer:
        """Renders rays in normalised coordinates with the field as it is now."""
        return renderer(state.field, self.frame, self.executor)


def fast_training(
    images: tuple[PosedImage, ...],
    frame: FieldFrame,
    plan: FastPlan,
    *,
    seed: int,
    executor: Executor,
    use_alpha: bool = True,
    points_in_world: Float[np.ndarray, "p 3"] | None = None,
    seen: Mapping[str, SeenPoints] | None = None,
    bounded: bool = True,
    refine_poses: bool = False,
) -> FastTraining:
    """The training of a fast field on posed photos.

    The box is `NORMALIZED_RADIUS` around the origin of the frame. Where photos have alpha, it shrinks to the visual
    hull. An open scene whose photos look the same way gets a projective space; in others everything beyond the
    box is contracted into a shell around it.

    Args:
        points_in_world: Known points, which tell how near things are.
        seen: What each photo is known to see.
        bounded: Nothing lies beyond the box.
        use_alpha: False takes photos with alpha as photos on the background of the frame.
        refine_poses: Keep what a plan with `refine_poses` needs.

    Raises:
        InputError: No ray meets the scene.
    """
    points = np.empty((0, 3)) if points_in_world is None else points_in_world
    space, bounds = space_of(images, frame, points, bounded=bounded)
    occupancy = full_box(bounds[0], bounds[1] - bounds[0], HULL_CELLS // 2 if bounded else FREE_CELLS)
    alpha_known = use_alpha and all(image.pixels.shape[2] == 4 for image in images)
    if alpha_known and bounded:
        masks = [image.pixels[:, :, 3] > 0 for image in images]
        if not any(mask.any() for mask in masks):
            raise InputError("all photos are fully transparent: their alpha is 0 everywhere; train without alpha")
        poses = [_cam_from_normalized(image.cam_from_world, frame) for image in images]
        cameras = [image.camera for image in images]
        occupancy = visual_hull(occupancy, masks, cameras, poses, HULL_CELLS, executor).trimmed()
        logger.info("visual hull: %.1f %% of a box of %s", 100 * occupancy.cells.mean(), occupancy.extent.round(3))
        if not occupancy.cells.any():
            raise InputError(
                "the alpha masks leave nothing: no point lies on opaque pixels in all photos that show it; check that "
                "alpha is 255 on the object and that the poses belong to the photos, or train without alpha"
            )
    if seen:
        occupancy = carve_free_space(occupancy, images, frame, seen, space, executor)
        logger.info("seen to be free: %.1f %% of the box", 100 * (1 - occupancy.cells.mean()))
    box = occupancy_box(occupancy, occupancy.extent, space)
    free_of = probably_free(frame, seen) if seen and not space.is_projective else None
    table = ray_table(images, frame, box, executor, use_alpha=use_alpha, free_of=free_of)
    known, on_rays = known_rays(images, frame, seen, space) if seen else no_known_rays()
    places = grid_from_normalized(space, frame.normalized_from_world.apply(points))
    movable = movable_photos(images, frame, seen) if refine_poses else ()
    return FastTraining(
        table, known, on_rays, frame, occupancy, space, plan, seed, executor, places, alpha_known,
        movable,
    )  # fmt: skip


def space_of(
    images: tuple[PosedImage, ...], frame: FieldFrame, points_in_world: Float[np.ndarray, "p 3"], *, bounded: bool
) -> tuple[Space, Float[np.ndarray, "2 3"]]:
    """The space that suits a scene, and the lower and upper corner of its grid."""
    if bounded:
        return box_space(), NORMALIZED_RADIUS * np.array([[-1.0] * 3, [1.0] * 3])
    projected = projection_for(images, frame, points_in_world)
    if projected is not None:
        projection, bounds = projected
        return projective_space(projection), bounds
    return contracted_space(), 2.0 * NORMALIZED_RADIUS * np.array([[-1.0] * 3, [1.0] * 3])


def _cam_from_normalized(cam_from_world: Rigid3, frame: FieldFrame) -> Rigid3:
    """Pose of a camera in the frame; lengths are those of the frame."""
    world = frame.normalized_from_world
    R = cam_from_world.R @ world.R.T
    return Rigid3(R, -R @ world.apply(cam_from_world.target_origin_in_source()))
