"""Training with all that real scenes need: known points, exposures, free space, masks, distortion."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.evaluate.image_metrics import psnr
from fieldstone.field.base.ray_dataset import SeenPoints
from fieldstone.field.base.space import contracted_space
from fieldstone.field.grid.field import occupancy_box
from fieldstone.field.grid.occupancy import full_box
from fieldstone.field.grid.rays import ray_table
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.geometry.camera import Camera, image_from_cam
from fieldstone.scene.rays import rays_from_view
from grid_scenes import CAMERA, FRAME, RADIUS, THIRD_OF_ERROR_DB, ball_photos, photographs, plan_of, psnr_of_one_color

PLAN = plan_of(
    finest=32,
    steps=(20, 20, 20, 20, 20, 10, 5, 5),
    num_chunks=4,
    samples_per_chunk=512,
    box_warm_up=False,
    density_bias=-3.0,
    prune_density=0.01,
    min_weight=4e-3,
    clear_initial_density_from=4,
    exposure_rate=0.03,
    sparse_depth_weight=0.1,
)

GAINS = 1.0 + 0.25 * np.cos(2.0 * np.arange(20))


def photographed(seed=0):
    """The ball before black, every photo with another exposure, and points on it that each photo sees."""
    rng = np.random.default_rng(seed)
    photos, pixels, seen = ball_photos(20), [], []
    for gain, rgba, center in zip(GAINS, photos.pixels, photos.posed.centers(), strict=True):
        rgb = np.where(rgba[..., 3:] > 127, rgba[..., :3], 0) * 0.7 * gain
        pixels.append(np.rint(rgb).astype(np.uint8))
        p = rng.normal(size=(200, 3))
        p *= RADIUS / np.linalg.norm(p, axis=1, keepdims=True)
        facing = p[np.einsum("ni,ni->n", p, center - p) > 0.3]
        seen.append(SeenPoints(facing, np.full(len(facing), 0.01)))
    return replace(photos, pixels=tuple(pixels)), tuple(seen)


def training(executor, photos, seen, plan=PLAN) -> GridTraining:
    points = np.concatenate([points.xyz for points in seen])
    dark = replace(FRAME, background=np.zeros(3))
    return prepare_grid_training(
        photos, dark, plan, seed=0, executor=executor, points_in_world=points, seen=seen, bounded=False
    )


def run(work, state, steps):
    for _ in range(steps):
        state, _ = work.advance(state)
    return state


def same_tensors(a, b):
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_neither_threads_nor_a_stop_change_a_bit():
    photos, seen = photographed()
    results = []
    for threads in (1, 2):
        with ThreadPoolExecutor(threads) as executor:
            work = training(executor, photos, seen)
            state = run(work, work.start(), 45)
            if threads == 2:
                saved = {name: array.copy() for name, array in work.to_tensors(state).items()}
                state = work.from_tensors(saved)
            results.append(work.to_tensors(run(work, state, PLAN.schedule.total_steps - 45)))
    same_tensors(*results)
    assert np.any(results[0]["exposure_log_gain"] != 0)


def test_the_exposures_of_photos_are_told_from_the_colours_of_the_scene():
    photos, seen = photographed()
    with ThreadPoolExecutor(2) as executor:
        work = training(executor, photos.select(range(1, 20)), seen[1:])
        state = run(work, work.start(), PLAN.schedule.total_steps)
        shown = work.renderer(state)(rays_from_view(CAMERA, photos.posed.pose_of(0))).rgb
    found = np.exp(state.exposure.log_gain.reshape(-1, 3).mean(axis=1))
    assert np.corrcoef(found, GAINS[1:])[0, 1] > 0.9
    # With the mean exposure of all photos; the held-out one is 25 % brighter.
    as_mean = np.rint(photos.pixels[0] / GAINS[0] * np.exp(np.log(GAINS[1:]).mean()))
    shown = shown.reshape(CAMERA.height, CAMERA.width, 3)
    assert psnr(shown, as_mean / 255.0) > psnr_of_one_color(photos, 0) + THIRD_OF_ERROR_DB


@pytest.mark.parametrize("clear", [True, False])
def test_a_speck_in_the_air_is_given_up_when_its_stage_begins(clear):
    """Set by hand just before stage 3, beside spots of the same size on the ball, where there are known points."""
    photos, seen = photographed()
    stage = 3
    plan = PLAN.replaced(clear_floaters_from=stage if clear else len(PLAN.schedule.steps))
    with ThreadPoolExecutor(1) as executor:
        work = training(executor, photos, seen, plan)
        state = run(work, work.start(), sum(PLAN.schedule.steps[:stage]) - 1)
        layout, occupancy = state.field.layout, state.field.occupancy
        state.field.table[:] = 0.0
        layout.level(state.field.table, 0)[..., 0] = -9.0
        centers = occupancy.centers().reshape(*occupancy.cells.shape, 3)
        free = occupancy.cells & (abs(centers).max(axis=-1) < 1.0) & (np.linalg.norm(centers, axis=-1) > 1.4)
        spots = RADIUS * np.vstack([np.eye(3), -np.eye(3)])
        for place in (*spots, speck := centers[free][0]):
            i, j, k = np.rint((place - occupancy.lower) / layout.spacings[-1]).astype(int)
            layout.level(state.field.table, layout.num_levels - 1)[i - 1 : i + 2, j - 1 : j + 2, k - 1 : k + 2, 0] = (
                18.0
            )
        state = run(work, state, 2)
        left = state.field.density(np.vstack([spots, speck])) > 0
    assert left[:-1].all()
    assert left[-1] != clear


def test_what_masks_leave_out_is_not_learned():
    """A wrong colour in a third of every photo does no harm under masks."""
    photos, _ = photographed()
    keep = np.ones((CAMERA.height, CAMERA.width), dtype=bool)
    keep[:, 26:] = False
    wrong = tuple(np.where(keep[..., None], pixels, np.array([0, 255, 0], dtype=np.uint8)) for pixels in photos.pixels)
    masked = replace(photos, pixels=wrong, keep=(keep,) * len(photos))
    with ThreadPoolExecutor(1) as executor:
        box = full_box(np.full(3, -1.5), np.full(3, 3.0), 4)
        rays = ray_table(masked, FRAME, occupancy_box(box, box.extent, contracted_space()), executor)
    assert len(rays.image) == len(photos) * 26 * CAMERA.height
    assert not np.any((rays.rgba[:, 1] == 255) & (rays.rgba[:, 0] == 0))


@pytest.mark.parametrize(
    ("model", "lens"),
    [("OPENCV", [-0.2, 0.05, 0.002, -0.001]), ("OPENCV_FISHEYE", [0.05, -0.02, 0.003, 0.0]), ("SIMPLE_RADIAL", [0.1])],
)
def test_rays_of_distorted_photos_are_exact(model, lens):
    """A point on any ray of the table is seen by the distorted camera in the middle of the pixel of that ray."""
    focal = [45.0] if model == "SIMPLE_RADIAL" else [45.0, 44.0]
    camera = Camera(model, 40, 32, np.array([*focal, 20.5, 15.5, *lens]))
    pixels = np.arange(40 * 32 * 3).reshape(32, 40, 3).astype(np.uint8)
    photos = photographs(camera, [ball_photos(3).posed.pose_of(v) for v in range(3)], [pixels] * 3)
    box = full_box(np.full(3, -1.5), np.full(3, 3.0), 4)
    with ThreadPoolExecutor(1) as executor:
        table = ray_table(photos, FRAME, occupancy_box(box, box.extent, contracted_space()), executor)
    d = np.einsum("nij,nj->ni", table.rotations[table.image], table.bearings[table.bearing]).astype(np.float64)
    for v in range(3):
        rows = table.image == v
        points = table.centers[v] + 3.0 * d[rows]
        found = image_from_cam(camera, photos.posed.pose_of(v).apply(points))
        expected = np.stack([table.bearing[rows] % 40 + 0.5, table.bearing[rows] // 40 + 0.5], axis=1)
        # float32 rays: a few 1e-6 of the focal length.
        np.testing.assert_allclose(found, expected, atol=1e-3)
        shown = pixels.reshape(-1, 3)[table.bearing[rows]]
        np.testing.assert_array_equal(table.rgba[rows, :3], shown)
