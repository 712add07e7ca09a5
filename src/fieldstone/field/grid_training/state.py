"""What a training of the fast field knows between two steps, and how that changes when grids grow."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.exposure import Exposure
from fieldstone.field.grid.field import FastField
from fieldstone.field.grid.layout import grid_layout
from fieldstone.field.grid.rays import RayTable
from fieldstone.field.grid_training.buffers import Workspace, workspace
from fieldstone.field.grid_training.plan import FastPlan


@dataclass(frozen=True, eq=False)
class FastState:
    """Everything that the next step depends on. The arrays are updated in place by `FastTraining.step`."""

    plan: FastPlan
    step: int
    cursor: int
    """Rays drawn so far."""
    chunk_rays: Int[np.ndarray, "c"]
    """Rays that each chunk should draw next to fill its room."""
    field: FastField
    velocity: Float[np.ndarray, "t"]
    """Mean squared gradient of each value of the grid."""
    decoder_mean: Decoder
    decoder_square: Decoder
    exposure: Exposure
    """Of every photo; all 1 unless the plan says that they are learned."""
    moved: Float[np.ndarray, "v 6"]
    """Tangents from the given poses of the photos to the refined ones, in the world."""
    rays: RayTable
    """The table of rays from the refined poses; follows from `moved`."""
    known: RayTable
    """The rays to known points from the refined poses; follows from `moved`."""
    workspace: Workspace
    """Room for the next step; follows from the rest."""

    def with_plan(self, plan: FastPlan) -> FastState:
        """The same state, with other steps to come."""
        return replace(self, plan=plan)


def next_rays(rays: Int[np.ndarray, "c"], samples: Int[np.ndarray, "c"], room: int) -> Int[np.ndarray, "c"]:
    """Rays that would fill the room if they had as many samples as the last ones, and a quarter more."""
    return np.clip((1.25 * rays * room / np.maximum(samples, 1)).astype(np.int64), room // 64, room)


def grown(state: FastState, resolutions: tuple[int, ...], num_images: int) -> FastState:
    """The same field on more levels: old levels keep their values, new ones start at 0."""
    old = state.field.layout
    new = grid_layout(old.extent, resolutions)
    table, velocity = np.zeros((2, new.num_values), dtype=np.float32)
    for level, resolution in enumerate(old.resolutions):
        target = new.resolutions.index(resolution)
        new.level(table, target)[:] = old.level(state.field.table, level)
        new.level(velocity, target)[:] = old.level(state.velocity, level)
    field = replace(state.field, layout=new, table=table)
    return replace(state, field=field, velocity=velocity, workspace=workspace(field, state.plan, num_images))
