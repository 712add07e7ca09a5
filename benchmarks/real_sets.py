"""Photos to judge `reconstruct` by: where they lie, what is known of them, and which of them may be looked at.

Half of the sets are there to develop on. The others only confirm: nothing is chosen by what they show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from benchmarks.data import DATA
from benchmarks.ground_truth import (
    posed,
    read_bundler,
    read_dino,
    read_image_matching,
    read_made_poses,
    read_poses_bounds,
    read_pseudo_truth,
    read_strecha,
    read_transforms,
)
from benchmarks.made_sets import made_set
from fieldstone.features.verification import verify_pairs
from fieldstone.io.models.colmap import read_colmap
from fieldstone.run.matching.photos_to_graph import MatchedPhotos
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.robust.two_view import TwoViewOptions
from fieldstone.synthetic.repeated_structure import RepeatedScene
from fieldstone.synthetic.street import StreetOptions, synthesize_street
from fieldstone.synthetic.symmetric import SymmetricOptions, synthesize_symmetric

Half = Literal["develop", "confirm"]
Truth = Literal["metric", "similar", "poses", "loose", "none"]
"""What the truth is good for: lengths in metres; everything up to a similarity; poses without cameras; rotations of 10
against 30 degrees."""
Input = Path | MatchedPhotos
"""A folder of photos, or matches that were made without photos."""


@dataclass(frozen=True)
class RealSet:
    """One set of photos."""

    name: str
    half: Half
    expected: int
    """Photos that belong to one model; 0 where the input is to be refused."""
    source: Callable[[Path], tuple[Input, Reconstruction | None]]
    """The photos, and the truth. Its argument is a folder for what has to be made."""
    truth: Truth = "none"
    needs: str | None = None
    """Folder or file below the data; None: the set is made here."""
    large: bool = False
    """Takes minutes: only where it is named."""

    def is_present(self) -> bool:
        """Whether the data are there."""
        return self.needs is None or (DATA / self.needs).exists()


def on_disk(
    name: str, half: Half, expected: int, photos: str, truth: Truth = "none",
    read: Callable[[], Reconstruction] | None = None, *, large: bool = False,
) -> RealSet:  # fmt: skip
    """A set whose photos lie in a folder below the data."""

    def source(_: Path) -> tuple[Input, Reconstruction | None]:
        return DATA / photos, None if read is None else read()

    return RealSet(name, half, expected, source, truth, photos, large)


def every_frame(film: Path, step: int, folder: Path) -> Path:
    """Every `step`th frame of a film as PNG files in a folder, which is made once."""
    if not folder.is_dir():
        part = folder.with_name(folder.name + ".part")
        part.mkdir(parents=True, exist_ok=True)
        capture, k = cv2.VideoCapture(str(film)), 0
        while True:
            more, frame = capture.read()
            if not more:
                break
            if k % step == 0:
                cv2.imwrite(str(part / f"{k:05d}.png"), frame)
            k += 1
        part.rename(folder)
    return folder


def four_fold_building(_: Path, **settings: Any) -> tuple[Input, Reconstruction | None]:
    """Matches of a ring of photos around a building with sides that are the same, see `synthetic.symmetric`."""
    return _matched(synthesize_symmetric(SymmetricOptions(points_per_side=300, **settings), np.random.default_rng(0)))


def street_of_equal_houses(_: Path, **settings: Any) -> tuple[Input, Reconstruction | None]:
    """Matches of photos along a row of houses that are the same, see `synthetic.street`."""
    return _matched(synthesize_street(StreetOptions(**settings), np.random.default_rng(0)))


def _matched(scene: RepeatedScene) -> tuple[Input, Reconstruction | None]:
    """Verified matches with the camera known, and the truth."""
    one_camera = np.zeros(scene.graph.num_images, dtype=np.int64)
    graph = verify_pairs(scene.graph, scene.truth.cameras, one_camera, TwoViewOptions(), 0, 2)
    cameras = scene.truth.cameras
    matched = MatchedPhotos(graph, cameras, one_camera, np.zeros(1), lambda name: None, (), {})
    return matched, posed([v.name for v in scene.truth.views], [cameras[0]] * graph.num_images, poses_of(scene.truth))


def poses_of(model: Reconstruction) -> list:
    """`cam_from_world` of all views, which are registered."""
    return [model.pose_of(k) for k in range(len(model.views))]


def _film(folder: Path) -> tuple[Input, Reconstruction | None]:
    return every_frame(DATA / "video/colosseum.mp4", 12, folder / "colosseum"), None


def made(name: str, half: Half, expected: int) -> RealSet:
    """One of `made_sets`, with its truth."""
    return RealSet(name, half, expected, partial(made_set, name), "similar")


def _strecha(name: str) -> Callable[[], Reconstruction]:
    return partial(read_strecha, DATA / name / "gt_dense_cameras")


_HARD = DATA / "hard_inputs"
_COMET = "astrovision/test_2011212_opnav_022"

SETS: tuple[RealSet, ...] = (
    on_disk("castle_p30_half", "develop", 30, "castle_p30_half/images", "metric", _strecha("castle_p30_half")),
    on_disk("strecha_entry_p10", "develop", 10, "strecha_entry_p10/images", "metric", _strecha("strecha_entry_p10")),
    on_disk(
        "fox_half", "develop", 50, "fox_half/images", "similar",
        partial(read_transforms, DATA / "fox_half/transforms.json"),
    ),
    on_disk(
        "liberty_68", "develop", 68, "liberty_68", "loose", partial(read_pseudo_truth, DATA / "liberty_68/poses.json")
    ),
    on_disk("dino_ring", "develop", 16, "dino_ring", "similar", partial(read_dino, DATA / "dino_ring/dinoSR_par.txt")),
    on_disk(
        "two_lenses", "develop", 16, "hard_inputs/two_lenses", "similar",
        partial(read_made_poses, _HARD / "two_lenses/truth.json", (330.0, 560.0)),
    ),
    on_disk("odm_banana", "develop", 16, "odm_banana/images"),
    on_disk("sagrada_familia", "develop", 4, "sagrada_familia/images"),
    on_disk("opensfm_lund", "develop", 29, "opensfm_lund/images"),
    on_disk("unity_hall", "develop", 5, "unity_hall"),
    RealSet("four_fold", "develop", 28, partial(four_fold_building, unique_share=0.1), "similar"),
    RealSet("street", "develop", 25, street_of_equal_houses, "similar"),
    RealSet(
        "front_and_back_alike", "confirm", 28,
        partial(four_fold_building, looks=(0, 1, 0, 2), unique_share=0.2), "similar",
    ),
    RealSet("street_unique", "confirm", 25, partial(street_of_equal_houses, unique_share=0.3), "similar"),
    RealSet("ordinary_street", "confirm", 25, partial(street_of_equal_houses, houses_differ=True), "similar"),
    on_disk(
        "strecha_fountain_p11", "confirm", 11, "strecha_fountain_p11/images", "metric", _strecha("strecha_fountain_p11")
    ),
    on_disk(
        "reichstag", "confirm", 10, "reichstag/images", "similar",
        partial(read_image_matching, DATA / "reichstag/calibration"),
    ),
    on_disk("statue", "confirm", 9, "statue/images"),
    RealSet("colosseum", "confirm", 48, _film, needs="video/colosseum.mp4"),
    on_disk(
        "lund_door", "confirm", 12, "lund_door/images", "similar",
        partial(read_colmap, DATA / "lund_door/colmap_ground_truth"),
    ),
    on_disk(
        "llff_fern", "confirm", 20, "llff_fern/images_8", "similar", partial(read_poses_bounds, DATA / "llff_fern")
    ),
    on_disk("astrovision", "confirm", 4, f"{_COMET}/images", "similar", partial(read_colmap, DATA / _COMET)),
    on_disk(
        "balbianello", "confirm", 5, "balbianello/Balbianello", "similar",
        partial(read_bundler, DATA / "balbianello/Balbianello.out", DATA / "balbianello/Balbianello"),
    ),
    on_disk("opensfm_berlin", "confirm", 3, "opensfm_berlin/images"),
    on_disk(
        "equirect", "confirm", 0, "hard_inputs/equirect", "poses",
        partial(read_made_poses, _HARD / "equirect/truth.json", (163.0,)),
    ),
    RealSet(
        "four_fold_alike", "confirm", 28,
        partial(four_fold_building, unique_share=0.05, max_view_change_deg=180.0), "similar",
    ),
    made("plain_house", "develop", 12),
    made("overlay", "develop", 12),
    made("letterbox", "develop", 12),
    made("turntable_rgba", "develop", 24),
    made("exif_zoom_1_8", "develop", 12),
    made("half_exif_wrong", "develop", 12),
    made("mirrored_one", "develop", 11),
    made("watermark", "confirm", 12),
    made("turntable_background", "confirm", 24),
    made("exif_right", "confirm", 12),
    made("exif_zoom_1_8_stated", "confirm", 12),
    made("exif_too_long", "confirm", 12),
    made("ten_copies", "confirm", 12),
    made("panorama_among", "confirm", 12),
    on_disk("odm_seneca_1200", "confirm", 167, "odm_seneca_1200/images", large=True),
)  # fmt: skip


def chosen(names: Sequence[str], half: Half | None, *, large: bool = False) -> list[RealSet]:
    """The sets of these names, or all, of one half or of both; large ones where they are named or asked for.

    Raises:
        ValueError: No set has this name.
    """
    known = {each.name: each for each in SETS}
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"no set is called {', '.join(unknown)}; there are: {', '.join(known)}")
    picked = [known[name] for name in names] if names else [each for each in SETS if large or not each.large]
    return [each for each in picked if half in (None, each.half)]
