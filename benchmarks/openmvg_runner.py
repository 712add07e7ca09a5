"""openmvg-rs on a folder of photos, as a process of its own: `python -m benchmarks.openmvg_runner JSON OUT`."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import openmvg_rs
from PIL import Image

from fieldstone.io.images.photos import list_photos


def main() -> None:
    """The incremental engine on photos of the given size; reducing them first is not counted, since it cannot."""
    setting, out = json.loads(sys.argv[1]), Path(sys.argv[2])
    with tempfile.TemporaryDirectory() as folder:
        factor = reduce(Path(setting["photos"]), setting["size"], Path(folder))
        intrinsics = None
        if setting["intrinsics"]:
            fx, fy, cx, cy = (factor * float(word) for word in setting["intrinsics"].split(","))
            intrinsics = Path(folder) / "K.txt"
            intrinsics.write_text(f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n")
        start = time.perf_counter()
        model = openmvg_rs.reconstruct(
            folder, seed=setting["seed"], intrinsics=intrinsics, progress=False, max_workers=setting["threads"]
        )
        seconds = {"everything": time.perf_counter() - start}
    (out / "sparse" / "0").mkdir(parents=True)
    model.write_colmap(str(out / "sparse" / "0"))
    (out / "run.json").write_text(json.dumps({"seconds": seconds}))


def reduce(photos: Path, size: int, folder: Path) -> float:
    """Photos with a longer side of at most `size` pixels in another folder, and the factor."""
    factor = 1.0
    for path in list_photos(photos):
        with Image.open(path) as photo:
            factor = min(1.0, size / max(photo.size))
            shape = tuple(round(factor * side) for side in photo.size)
            photo.convert("RGB").resize(shape, Image.Resampling.BOX).save(folder / path.name, quality=98)
    return factor


if __name__ == "__main__":
    main()
