"""What the trainings of all kinds of fields take, and what they give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fieldstone.field.base.ray_dataset import RayDataset
from fieldstone.field.grid_training.plan import GridPlan
from fieldstone.io.posed.posed_scene import PosedScene
from fieldstone.records.field import CurvePoint, FieldHeader
from fieldstone.run.evaluation import Evaluation
from fieldstone.run.field_input import Split


@dataclass(frozen=True, eq=False)
class TrainingInput:
    """Posed photos, not yet decoded, and which of them are held out."""

    scene: PosedScene
    split: Split


@dataclass(frozen=True, eq=False)
class Trained:
    """A field after its training: all that its checkpoint holds, and how it was made and measured."""

    header: FieldHeader
    tensors: Mapping[str, np.ndarray]
    curve: tuple[CurvePoint, ...]
    evaluation: Evaluation
    dataset: RayDataset
    seconds: float
    """Of reading and training, those before a stop included."""
    steps: int
    plan: GridPlan | None = None
    """What was followed, of a grid field."""
