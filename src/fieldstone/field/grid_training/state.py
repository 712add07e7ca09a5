"""What a training of the grid field knows between two steps, and how that changes when grids grow."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fieldstone.field.grid.decoder import Decoder
from fieldstone.field.grid.exposure import Exposure
from fieldstone.field.grid.field import GridField, compress, expand, field_from_tensors, reachable_vertices
from fieldstone.field.grid.layout import grid_layout
from fieldstone.field.grid.rays import RayTable
from fieldstone.field.grid_training.buffers import StepBuffers, step_buffers
from fieldstone.field.grid_training.plan import GridPlan, plan_from_json


@dataclass(frozen=True, eq=False)
class GridState:
    """Everything that the next step depends on.

    The arrays are stepped in place, for copying grids would take longer than a step: who steps a state gives it away,
    and goes on with the one that comes back (`claim`).
    """

    plan: GridPlan
    step: int
    """Steps done."""
    cursor: int
    """Rays drawn so far."""
    chunk_rays: Int[np.ndarray, "c"]
    """Rays that each chunk should draw next to fill its samples."""
    field: GridField
    mean_square: Float[np.ndarray, "t"]
    """Running mean of the squared gradient of each value of the grid."""
    decoder_first_moment: Decoder
    decoder_second_moment: Decoder
    exposure: Exposure
    """Of every photo; all 1 unless the plan says that they are learned."""
    pose_deltas: Float[np.ndarray, "v 6"]
    """Tangents from the given poses of the photos to the refined ones, in the world."""
    rays: RayTable
    """The table of rays from the refined poses; follows from `pose_deltas`."""
    depth_rays: RayTable
    """The rays to triangulated points from the refined poses; follows from `pose_deltas`."""
    buffers: StepBuffers
    """For the next step; follow from the rest."""

    def with_plan(self, plan: GridPlan) -> GridState:
        """The same state, with other steps to come."""
        return replace(self, plan=plan)


def claim(state: GridState) -> None:
    """Take over the arrays of a state for the next step.

    Raises:
        ValueError: They have been stepped already, and belong to a later state.
    """
    if int(state.buffers.steps_done) != state.step:
        raise ValueError(
            f"the state after {state.step} steps was stepped already: its arrays are those after "
            f"{int(state.buffers.steps_done)}; go on with the state that the step returned"
        )
    state.buffers.steps_done[()] = state.step + 1


def stepped(state: GridState, cursor: int, chunk_rays: Int[np.ndarray, "c"]) -> GridState:
    """The state whose arrays have gone through one more step."""
    state.buffers.steps_done[()] = state.step + 1
    return replace(state, step=state.step + 1, cursor=cursor, chunk_rays=chunk_rays)


def next_rays(rays: Int[np.ndarray, "c"], samples: Int[np.ndarray, "c"], capacity: int) -> Int[np.ndarray, "c"]:
    """Rays that would fill a chunk if they had as many samples as the last ones, and a quarter more."""
    return np.clip((1.25 * rays * capacity / np.maximum(samples, 1)).astype(np.int64), capacity // 64, capacity)


def grown(state: GridState, resolutions: tuple[int, ...], num_images: int) -> GridState:
    """The same field on more levels: old levels keep their values, new ones start at 0."""
    old = state.field.layout
    new = grid_layout(old.extent, resolutions)
    table, mean_square = np.zeros((2, new.num_values), dtype=np.float32)
    for level, resolution in enumerate(old.resolutions):
        target = new.resolutions.index(resolution)
        new.level(table, target)[:] = old.level(state.field.table, level)
        new.level(mean_square, target)[:] = old.level(state.mean_square, level)
    field = replace(state.field, layout=new, table=table)
    buffers = step_buffers(field, state.plan, num_images, state.step)
    return replace(state, field=field, mean_square=mean_square, buffers=buffers)


def state_to_tensors(state: GridState) -> dict[str, np.ndarray]:
    """The field, and what resuming needs besides. Names in files outlive those of the code."""
    reachable = reachable_vertices(state.field)
    tensors = state.field.to_tensors(reachable) | {
        "step": np.array(state.step, dtype=np.int64),
        "cursor": np.array(state.cursor, dtype=np.int64),
        "chunk_rays": state.chunk_rays,
        "moved": state.pose_deltas,
        "velocity": compress(state.field, state.mean_square, reachable),
        "plan": np.frombuffer(state.plan.to_json().encode(), dtype=np.uint8).copy(),
        "exposure_log_gain": state.exposure.log_gain,
        "exposure_mean": state.exposure.first_moment,
        "exposure_square": state.exposure.second_moment,
    }
    for name in Decoder._fields:
        tensors[f"mean_{name}"] = getattr(state.decoder_first_moment, name)
        tensors[f"square_{name}"] = getattr(state.decoder_second_moment, name)
    return tensors


def state_from_tensors(
    tensors: Mapping[str, np.ndarray], rays: RayTable, depth_rays: RayTable, num_images: int
) -> GridState:
    """The state of `state_to_tensors`.

    Args:
        rays, depth_rays: From the refined poses.

    Raises:
        InputError, KeyError, ValueError, TypeError: An array is missing or has the wrong shape.
    """
    field = field_from_tensors(tensors)
    plan, step = plan_from_json(tensors["plan"].tobytes().decode()), int(tensors["step"])
    exposure = (tensors[f"exposure_{name}"].copy() for name in ("log_gain", "mean", "square"))
    return GridState(
        plan=plan,
        step=step,
        cursor=int(tensors["cursor"]),
        chunk_rays=tensors["chunk_rays"].copy(),
        field=field,
        mean_square=expand(field, tensors["velocity"]).table,
        decoder_first_moment=Decoder(*(tensors[f"mean_{name}"].copy() for name in Decoder._fields)),
        decoder_second_moment=Decoder(*(tensors[f"square_{name}"].copy() for name in Decoder._fields)),
        exposure=Exposure(*exposure),
        pose_deltas=tensors["moved"].copy(),
        rays=rays,
        depth_rays=depth_rays,
        buffers=step_buffers(field, plan, num_images, step),
    )
