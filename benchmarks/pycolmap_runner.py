"""pycolmap on a folder of photos, as a process of its own: `python -m benchmarks.pycolmap_runner MAPPER JSON OUT`."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pycolmap
from PIL import Image


def main() -> None:
    """Features, exhaustive matching and one of the mappers, with CPU and the given number of threads."""
    mapper, setting, out = sys.argv[1], json.loads(sys.argv[2]), Path(sys.argv[3])
    seconds, database = {}, out / "database.db"
    pycolmap.set_random_seed(setting["seed"])
    threads, photos = setting["threads"], setting["photos"]

    start = time.perf_counter()
    reader = pycolmap.ImageReaderOptions()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu, extraction.max_image_size = threads, False, setting["size"]
    if setting["intrinsics"]:
        reader.camera_model, reader.camera_params = "PINHOLE", setting["intrinsics"]
    pycolmap.extract_features(
        database, photos, camera_mode=camera_mode(Path(photos)), reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip
    seconds["features"] = time.perf_counter() - start

    start = time.perf_counter()
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = threads, False
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
    seconds["matching"] = time.perf_counter() - start

    start = time.perf_counter()
    (out / "sparse").mkdir(parents=True)
    known = bool(setting["intrinsics"])
    if mapper == "incremental":
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = threads
        options.ba_refine_focal_length = options.ba_refine_extra_params = not known
        models = pycolmap.incremental_mapping(database, photos, out / "sparse", options)
    else:
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = threads
        bundle = options.mapper.bundle_adjustment
        bundle.refine_focal_length = bundle.refine_extra_params = not known
        models = pycolmap.global_mapping(database, photos, out / "sparse", options)
    seconds["mapping"] = time.perf_counter() - start
    best = max(models.values(), key=lambda model: model.num_reg_images())
    (out / "sparse" / "0").mkdir(exist_ok=True)
    best.write(out / "sparse" / "0")
    (out / "run.json").write_text(json.dumps({"seconds": seconds}))


def camera_mode(photos: Path) -> pycolmap.CameraMode:
    """One camera for photos of one size: without EXIF the default would give every photo its own."""
    sizes = {Image.open(path).size for path in photos.iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png")}
    return pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.AUTO


if __name__ == "__main__":
    main()
