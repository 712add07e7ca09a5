"""What a training leaves behind while it runs, so that a stopped one goes on where it was; and its header."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldstone.errors import InputError
from fieldstone.field.base.radiance_field import FieldFrame, FieldTraining
from fieldstone.field.base.ray_dataset import RayDataset
from fieldstone.geometry.rigid3 import Rigid3
from fieldstone.geometry.sim3 import Sim3
from fieldstone.records.field import CurvePoint, FieldHeader, FrameRecord
from fieldstone.records.mapping import CameraRecord
from fieldstone.run.folder import RunFolder

logger = logging.getLogger(__name__)


def header_of(kind: str, options: Mapping[str, Any], seed: int, dataset: RayDataset) -> FieldHeader:
    """What a checkpoint says of its run; equal headers mean that training can go on."""
    posed = dataset.train.posed
    return FieldHeader(
        field=kind,
        options=dict(options),
        seed=seed,
        photos=fingerprint(dataset),
        frame=frame_record(dataset.frame),
        names=posed.names,
        cameras=tuple(CameraRecord.of(camera) for camera in posed.cameras),
        camera_of_view=tuple(posed.camera_of_photo.tolist()),
    )


def fingerprint(dataset: RayDataset) -> str:
    """SHA-256 of the training photos as they are used, with names and poses."""
    digest = hashlib.sha256()
    photos, posed = dataset.train, dataset.train.posed
    for v, name in enumerate(posed.names):
        digest.update(f"{name}\n{photos.pixels[v].shape}\n".encode())
        arrays = [photos.pixels[v], posed.camera_of(v).params, posed.pose_of(v).R, posed.pose_of(v).t]
        keep, seen = photos.keep[v], dataset.seen[v] if dataset.seen else None
        arrays += [] if keep is None else [keep]
        arrays += [] if seen is None else [seen.xyz, seen.sigma]
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def frame_record(frame: FieldFrame) -> FrameRecord:
    """What a checkpoint says of a frame."""
    world = frame.normalized_from_world
    return FrameRecord(
        scale=float(world.scale),
        R=tuple(tuple(row) for row in world.R.tolist()),
        t=tuple(world.t.tolist()),
        near=float(frame.near),
        far=float(frame.far),
        background=tuple(frame.background.tolist()),
    )


def frame_of_record(record: FrameRecord) -> FieldFrame:
    """The frame that a checkpoint tells of."""
    world = Sim3(record.scale, np.array(record.R), np.array(record.t))
    return FieldFrame(world, record.near, record.far, np.array(record.background))


def state_of_tensors(tensors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The state of the field among the arrays of a checkpoint."""
    return {name.removeprefix("state."): array for name, array in tensors.items() if name.startswith("state.")}


@dataclass(frozen=True)
class TrainingCheckpoints:
    """Where one training is kept; without a folder, nowhere."""

    out: RunFolder | None
    header: FieldHeader
    cam_from_world: Rigid3
    """Poses of the training photos, for camera paths."""

    def resume(self, training: FieldTraining[Any]) -> tuple[Any, tuple[CurvePoint, ...]]:
        """The state and curve that an earlier run has left, or those of the start.

        Raises:
            InputError: The folder holds another field, or a damaged one.
        """
        if self.out is None or not self.out.checkpoint.exists():
            return training.start(), ()
        found, tensors = self.out.read_checkpoint()
        if other := self.header.differences(found):
            raise InputError(
                f"{self.out.path}: holds a field of another run (differs in: {', '.join(other)}); "
                "choose another output folder"
            )
        state_tensors = state_of_tensors(tensors)
        state = training.from_tensors(state_tensors)
        curve = self.out.read_curve()[: int(state_tensors["step"])]
        if len(curve) < int(state_tensors["step"]):
            raise InputError(f"{self.out.curve}: holds fewer steps than the checkpoint; train into a new folder")
        logger.info("going on after step %d, %.1f s", len(curve), curve[-1].seconds if curve else 0.0)
        return state, curve

    def keep(self, tensors: Mapping[str, np.ndarray], curve: Sequence[CurvePoint], plan: str | None = None) -> None:
        """Write the state of the field, its curve, and the plan that it follows.

        The curve first: after a stop between the two it holds steps too many, which are dropped.
        """
        if self.out is None:
            return
        self.out.write_curve(curve)
        if plan is not None:
            self.out.write_plan(plan)
        self.out.write_checkpoint(self.header, self.arrays(tensors))

    def arrays(self, tensors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """All arrays of the checkpoint of a state."""
        poses = {"views.R": self.cam_from_world.R, "views.t": self.cam_from_world.t}
        return poses | {f"state.{name}": array for name, array in tensors.items()}
