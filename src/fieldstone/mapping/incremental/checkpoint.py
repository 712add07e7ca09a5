"""What a growing model needs to go on where it was: its state after a global bundle adjustment."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import MatchGraph

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class GrowthState:
    """A model after a global adjustment, the rung of the ladder it is on, and what is told of each photo."""

    model: WorkingModel
    rung: int
    reasons: dict[int, str]
    failures: dict[int, str]


@runtime_checkable
class GrowthMemory(Protocol):
    """Keeps the last state of every growth; a growth is named by all that it depends on."""

    def find(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Arrays and facts of the last state."""
        ...

    def keep(self, name: str, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Replace the last state."""
        ...

    def name_of(self, *parts: Any) -> str:
        """A name for plain values, option dataclasses and arrays: equal parts, equal names."""
        ...


def pack_state(state: GrowthState) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The state without what does not change while a model grows: tracks, and which cameras took which photos."""
    poses, model = state.model.stacked_poses(), state.model
    arrays = {
        "registered": model.registered_mask(),
        "R": np.ascontiguousarray(poses.R),
        "t": np.ascontiguousarray(poses.t),
        "xyz": np.ascontiguousarray(model.xyz),
        "active": np.ascontiguousarray(model.active),
    }
    arrays |= {f"camera_{c}": np.ascontiguousarray(camera.params) for c, camera in enumerate(model.cameras)}
    texts = {name: [[view, text] for view, text in told.items()] for name, told in _told(state).items()}
    return arrays, {"rung": state.rung, **texts}


def unpack_state(start: WorkingModel, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> GrowthState:
    """The state of a model that grew from `start`."""
    poses = tuple(
        Rigid3(R, t) if registered else None
        for R, t, registered in zip(arrays["R"], arrays["t"], arrays["registered"].tolist(), strict=True)
    )
    params = [arrays[f"camera_{c}"] for c in range(len(start.cameras))]
    cameras = tuple(
        camera if np.array_equal(camera.params, found) else replace(camera, params=found)
        for camera, found in zip(start.cameras, params, strict=True)
    )
    model = replace(start, cameras=cameras, poses=poses, xyz=arrays["xyz"], active=arrays["active"])
    reasons, failures = ({int(view): str(text) for view, text in facts[name]} for name in ("reasons", "failures"))
    return GrowthState(model, int(facts["rung"]), reasons, failures)


@dataclass(frozen=True, eq=False)
class Kept:
    """The memory of one growth."""

    memory: GrowthMemory
    name: str

    def last(self, start: GrowthState) -> GrowthState:
        """The last state that was kept; the start if none was."""
        found = self.memory.find(self.name)
        if found is None:
            return start
        state = unpack_state(start.model, *found)
        logger.info("growth goes on from %d photos of an earlier run", state.model.registered_mask().sum())
        return state


def as_found_again(state: GrowthState, kept: Kept | None) -> WorkingModel:
    """The model as it comes back, after its state was kept where there is a memory.

    Without a memory too: even the order of an array in memory may change the last bit of a product.
    """
    arrays, facts = pack_state(state)
    if kept is not None:
        kept.memory.keep(kept.name, arrays, facts)
    return unpack_state(state.model, arrays, facts).model


def name_of_growth(
    memory: GrowthMemory, start: WorkingModel, graph: MatchGraph, free: Bool[np.ndarray, "n"], parts: list[Any]
) -> str:
    """A name for everything that the growth from `start` depends on, but the number of threads."""
    posed = [(pair, v, v.cam2_from_cam1) for pair, v in sorted(graph.two_views.items())]
    relative = [(pair, np.concatenate([pose.R.ravel(), pose.t])) for pair, _, pose in posed if pose is not None]
    arrays, _ = pack_state(GrowthState(start, 0, {}, {}))
    tracks = start.tracks
    return memory.name_of(
        *parts,
        free,
        start.camera_of_view,
        [camera.model for camera in start.cameras],
        *(arrays[name] for name in sorted(arrays)),
        *(tracks.view, tracks.keypoint, tracks.point, tracks.pixels),
        [[*pair, v.kind, int(v.inliers.sum())] for pair, v, _ in posed],
        [list(pair) for pair, _ in relative],
        np.array([row for _, row in relative]),
    )


def _told(state: GrowthState) -> dict[str, dict[int, str]]:
    return {"reasons": state.reasons, "failures": state.failures}
