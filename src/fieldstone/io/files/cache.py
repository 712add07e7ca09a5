"""What a run keeps of its finished units, so that a stopped run goes on where it was.

Below `OUT/work/` every stage has a folder. A unit (the features of a photo, the matches of a pair) is named by a key:
the hash of everything that it depends on. Whatever changes, the units that do not depend on it keep their keys and are
found again. Units lie in safetensors files with a checksum, one or many to a file; a damaged file is deleted, and its
units are made anew.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import fieldstone
from fieldstone.errors import InputError
from fieldstone.io.files.checkpoint import read_checkpoint, write_checkpoint

logger = logging.getLogger(__name__)

SUFFIX = ".safetensors"
BATCH = 128
"""Small units that go to disk together: at most so many are lost when a run is killed."""

Item = TypeVar("Item")
Value = TypeVar("Value")


@dataclass(frozen=True, eq=False)
class Unit:
    """A finished piece of work, as arrays and plain JSON values."""

    arrays: Mapping[str, np.ndarray]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Packing:
    """How values of one kind become units and come back, exactly."""

    pack: Callable[[Any], Unit]
    unpack: Callable[[Unit], Any]


@dataclass(frozen=True)
class UnitCache:
    """The folder of one run's units; without a folder, nothing is kept and nothing is found."""

    folder: Path | None = None

    def find(self, stage: str, key: str) -> Unit | None:
        """The unit that has a file of its own."""
        if self.folder is None:
            return None
        return _read(self.folder / stage / f"{key}{SUFFIX}").get(key)

    def keep(self, stage: str, key: str, unit: Unit) -> None:
        """Write a unit to a file of its own, whole or not at all."""
        self.keep_together(stage, {key: unit}, key)

    def find_all(self, stage: str) -> dict[str, Unit]:
        """All units of a stage, by key."""
        return {key: unit for path in self._files(stage) for key, unit in _read(path).items()}

    def keep_together(self, stage: str, units: Mapping[str, Unit], name: str) -> None:
        """Write units to one file."""
        if self.folder is None:
            return
        arrays = {f"{key}/{name}": array for key, unit in units.items() for name, array in unit.arrays.items()}
        facts = {key: dict(unit.facts) for key, unit in units.items()}
        write_checkpoint(self.folder / stage / f"{name}{SUFFIX}", arrays, facts)

    def forget_others(self, stage: str, names: Iterable[str]) -> None:
        """Delete the files of a stage but these: what no longer belongs to the run."""
        kept = set(names)
        for path in self._files(stage):
            if path.stem not in kept:
                path.unlink(missing_ok=True)

    def _files(self, stage: str) -> list[Path]:
        return [] if self.folder is None else sorted((self.folder / stage).glob(f"*{SUFFIX}"))


def key_of(*parts: Any) -> str:
    """Hash of plain values, option dataclasses and arrays: equal parts give equal keys, on any machine."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            text = f"{part.dtype.str}{part.shape}".encode()
            digest.update(text + np.ascontiguousarray(part).tobytes())
        else:
            digest.update(json.dumps(part, sort_keys=True, default=_plain).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:32]


@functools.cache
def code_version() -> str:
    """Hash of this program's sources: other code may give other results, whatever the version says."""
    package = Path(fieldstone.__file__).resolve().parent
    sources = sorted(package.rglob("*.py"))
    return key_of(*[[path.relative_to(package).as_posix(), file_hash(path)] for path in sources])


def file_hash(path: Path) -> str:
    """Hash of a file's bytes.

    Raises:
        InputError: The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error


def resumed(
    cache: UnitCache,
    stage: str,
    keys: Sequence[str],
    items: Sequence[Item],
    work: Callable[[Sequence[Item]], Iterator[Value]],
    packing: Packing,
) -> list[Value]:
    """`work` on the items whose keys are not found, in batches that are kept as soon as they are done.

    Args:
        work: Values of the items that it is given, in their order.

    Returns:
        The value of every item, as if `work` had been given all.
    """
    if cache.folder is None:
        return list(work(items))
    found = cache.find_all(stage)
    values = {key: packing.unpack(found[key]) for key in keys if key in found}
    missing = [(key, item) for key, item in zip(keys, items, strict=True) if key not in values]
    if values:
        logger.info("%s: %d of %d found from an earlier run", stage, len(keys) - len(missing), len(keys))
    batch: dict[str, Unit] = {}
    for (key, _), value in zip(missing, work([item for _, item in missing]), strict=True):
        unit = _in_c_order(packing.pack(value))
        values[key] = packing.unpack(unit)
        batch[key] = unit
        if len(batch) == BATCH:
            cache.keep_together(stage, batch, key_of(*batch))
            batch = {}
    name = key_of(*sorted(keys))
    if missing or set(found) != set(keys):
        cache.keep_together(stage, {key: packing.pack(values[key]) for key in keys}, name)
    cache.forget_others(stage, [name])
    return [values[key] for key in keys]


def _in_c_order(unit: Unit) -> Unit:
    """As it will come back from disk: even the order of an array in memory may change the last bit of a product."""
    return Unit({name: np.ascontiguousarray(array) for name, array in unit.arrays.items()}, unit.facts)


def _read(path: Path) -> dict[str, Unit]:
    """Units of a file; none of a missing or damaged one, which is deleted."""
    if not path.is_file():
        return {}
    try:
        arrays, facts = read_checkpoint(path)
    except InputError:
        logger.warning("%s is damaged: its content is computed anew", path)
        path.unlink(missing_ok=True)
        return {}
    by_key: dict[str, dict[str, np.ndarray]] = {key: {} for key in facts}
    for name, array in arrays.items():
        key, _, rest = name.partition("/")
        by_key[key][rest] = array
    return {key: Unit(by_key[key], facts[key]) for key in facts}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {"": type(value).__name__, **{f.name: getattr(value, f.name) for f in dataclasses.fields(value)}}
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.tolist()]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a key cannot depend on a {type(value).__name__}")
