"""Checkpoints of the mapper: the registration state after every global adjustment, to go on from when stopped."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.mapping.incremental.state import RegistrationState, RegistrationTask
from fieldstone.mapping.model.working_model import WorkingModel
from fieldstone.scene.match_graph import ImagePair

logger = logging.getLogger(__name__)

Packed = tuple[dict[str, np.ndarray], dict[str, Any]]
"""Arrays and plain facts of a state."""


@runtime_checkable
class CheckpointStore(Protocol):
    """Keeps the last state of every registration, by a name for all that it depends on."""

    def find(self, name: str) -> Packed | None:
        """Arrays and facts of the last state."""
        ...

    def keep(self, name: str, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Replace the last state."""
        ...

    def name_of(self, *parts: Any) -> str:
        """A name for plain values, option dataclasses and arrays: equal parts, equal names."""
        ...


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The place of one registration in a store; without a store nothing is kept."""

    store: CheckpointStore | None
    name: str = ""

    @staticmethod
    def of(
        store: CheckpointStore | None, start: RegistrationState, initial_pair: ImagePair, task: RegistrationTask
    ) -> Checkpoint:
        """The place of the registration that begins with a state."""
        return Checkpoint(store, "" if store is None else _name(store, start.model, initial_pair, task))

    def last(self, start: RegistrationState) -> RegistrationState:
        """The last state that was kept; the start if none was."""
        found = None if self.store is None else self.store.find(self.name)
        if found is None:
            return start
        state = unpack_state(start.model, found)
        logger.info("registration goes on from %d photos of an earlier run", state.model.num_registered)
        return state

    def keep(self, state: RegistrationState) -> RegistrationState:
        """The state as it would come back, after it was kept where there is a store.

        Without a store too: even the order of an array in memory may change the last bit of a product.
        """
        packed = pack_state(state)
        if self.store is not None:
            self.store.keep(self.name, *packed)
        return unpack_state(state.model, packed)


def pack_state(state: RegistrationState) -> Packed:
    """A state right after a global adjustment, without what stays the same: tracks, and who took which photo."""
    model = state.model
    arrays = {
        "registered": model.registered,
        "R": model.cam_from_world.R,
        "t": model.cam_from_world.t,
        "xyz": model.xyz,
        "active": model.active,
    }
    arrays |= {f"camera_{c}": camera.params for c, camera in enumerate(model.cameras)}
    facts = {
        "retry_stage": state.retry_stage,
        "reasons": [[view, text] for view, text in state.reasons.items()],
        "failures": [[view, text] for view, text in state.failures.items()],
    }
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}, facts


def unpack_state(start: WorkingModel, packed: Packed) -> RegistrationState:
    """The state of a model that began as `start`."""
    arrays, facts = packed
    params = [arrays[f"camera_{c}"] for c in range(len(start.cameras))]
    cameras = tuple(
        camera if np.array_equal(camera.params, found) else replace(camera, params=found)
        for camera, found in zip(start.cameras, params, strict=True)
    )
    model = replace(
        start,
        cameras=cameras,
        cam_from_world=Rigid3(arrays["R"], arrays["t"]),
        registered=arrays["registered"],
        xyz=arrays["xyz"],
        active=arrays["active"],
    )
    reasons, failures = ({int(view): str(text) for view, text in facts[name]} for name in ("reasons", "failures"))
    return RegistrationState(model, model.num_registered, int(facts["retry_stage"]), reasons=reasons, failures=failures)


def _name(store: CheckpointStore, start: WorkingModel, initial_pair: ImagePair, task: RegistrationTask) -> str:
    """A name for everything that a registration depends on, but the number of threads."""
    arrays, _ = pack_state(RegistrationState.start(start, {}))
    tracks = start.tracks
    return store.name_of(
        list(initial_pair),
        list(task.calibration),
        task.options.with_threads(1),
        task.seed,
        task.available,
        start.camera_of_view,
        start.pixel_scale,
        [camera.model for camera in start.cameras],
        *(arrays[name] for name in sorted(arrays)),
        *(tracks.view, tracks.keypoint, tracks.point, tracks.pixels),
        *_two_view_parts(task),
    )


def _two_view_parts(task: RegistrationTask) -> Sequence[Any]:
    """Kinds, inliers and relative poses of all pairs."""
    pairs = sorted(task.graph.two_views.items())
    posed = [(pair, v.cam2_from_cam1) for pair, v in pairs if v.cam2_from_cam1 is not None]
    return (
        [[*pair, v.kind, int(v.inliers.sum())] for pair, v in pairs],
        [list(pair) for pair, _ in posed],
        np.array([np.concatenate([pose.R.ravel(), pose.t]) for _, pose in posed]),
    )
