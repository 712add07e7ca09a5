"""Checkpoints of the mapper on disk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldstone.io.files.cache import Unit, UnitCache, code_version, key_of

STAGE = "mapper"


@dataclass(frozen=True)
class MapperCheckpoints:
    """A `mapping.incremental.checkpoint.CheckpointStore` over the cache of a run."""

    cache: UnitCache

    def find(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
        """Arrays and facts of the last state."""
        unit = self.cache.find(STAGE, name)
        return None if unit is None else (dict(unit.arrays), dict(unit.facts))

    def keep(self, name: str, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
        """Replace the last state."""
        self.cache.keep(STAGE, name, Unit(arrays, facts))

    def name_of(self, *parts: Any) -> str:
        """A name for plain values, option dataclasses and arrays: equal parts, equal names."""
        return key_of(code_version(), *parts)

    def forget(self) -> None:
        """Delete all states: the models are finished and written."""
        self.cache.forget_others(STAGE, [])
