"""A registration that is stopped goes on where it was, and ends the same."""

from dataclasses import replace

import numpy as np
import pytest

from fieldstone.geometry.camera import Camera
from fieldstone.io.files.cache import UnitCache
from fieldstone.mapping.incremental.mapper import map_incremental
from fieldstone.mapping.incremental.options import IncrementalOptions
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model.calibration import CalibrationStep, as_model
from fieldstone.run.mapper_checkpoint import MapperCheckpoints
from fieldstone.synthetic.scenes import SceneOptions, synthesize

STARTING_STEP = CalibrationStep("SIMPLE_RADIAL", ("f", "k"))
CAMERA = Camera("SIMPLE_PINHOLE", 1000, 750, np.array([800.0, 500.0, 375.0]))
ONE_CAMERA = np.zeros(9, dtype=np.int64)


class Stopped(Exception):
    """In place of a killed process."""


class Fragile(MapperCheckpoints):
    """Stops the run once so many states were kept."""

    def keep(self, name, arrays, facts):
        super().keep(name, arrays, facts)
        assert self.cache.folder is not None
        count = self.cache.folder / "count"
        done = int(count.read_text()) + 1 if count.exists() else 1
        count.write_text(str(done))
        if done in (2, 4):
            raise Stopped


@pytest.fixture(scope="module")
def scene():
    options = SceneOptions(num_cameras=9, num_points=250, noise_px=0.5, outlier_share=0.2, camera=CAMERA)
    return synthesize(options, np.random.default_rng(2))


def register(scene, store=None, seed: int = 0, threads: int = 1) -> list[SubModel]:
    camera = as_model(CAMERA, STARTING_STEP.model)
    options = IncrementalOptions().with_threads(threads)
    return map_incremental(scene.verified_graph(), [camera], ONE_CAMERA, [STARTING_STEP], options, seed, store)


def bits(sub_models: list[SubModel]) -> list:
    out = []
    for g in sub_models:
        poses = g.model.cam_from_world
        arrays = (poses.R, poses.t, g.model.xyz, g.model.active, g.model.cameras[0].params)
        out.append(([a.tobytes() for a in arrays], g.reasons, g.failures, g.initial_pair))
    return out


def test_registration_goes_on_to_the_same_bits(scene, tmp_path):
    whole = bits(register(scene))
    store = Fragile(UnitCache(tmp_path))
    for _ in range(2):
        with pytest.raises(Stopped):
            register(scene, store)
    assert bits(register(scene, store, threads=2)) == whole
    total = int((tmp_path / "count").read_text())
    whole_store = MapperCheckpoints(UnitCache(tmp_path / "whole"))
    assert bits(register(scene, whole_store)) == whole
    assert total <= 9  # two of them made, and none made twice
    store.forget()
    assert not list(tmp_path.glob("mapper/*"))


def test_another_seed_or_graph_finds_nothing(scene, tmp_path):
    store = MapperCheckpoints(UnitCache(tmp_path))
    register(scene, store)
    names = {path.stem for path in tmp_path.glob("mapper/*")}
    register(scene, store, seed=1)
    noisier = replace(scene, graph=replace(scene.graph, keypoints=tuple(k + 0.25 for k in scene.graph.keypoints)))
    register(noisier, store)
    assert len(names) == 1
    assert len({path.stem for path in tmp_path.glob("mapper/*")}) == 3
