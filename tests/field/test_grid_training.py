import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from fieldstone.errors import InputError
from fieldstone.evaluate.image_metrics import psnr
from fieldstone.field.base.radiance_field import FieldTraining
from fieldstone.field.base.space import box_space
from fieldstone.field.grid.field import compress, expand, field_from_tensors, occupancy_box, reachable_vertices
from fieldstone.field.grid.occupancy import Occupancy
from fieldstone.field.grid.occupancy_numba import rays_that_hit
from fieldstone.field.grid.rays import coprime_stride, pixels_that_hit
from fieldstone.field.grid_training.budget import corrected, plan_for_budget
from fieldstone.field.grid_training.plan import plan_from_json
from fieldstone.field.grid_training.prepare import prepare_grid_training
from fieldstone.field.grid_training.training import GridTraining
from fieldstone.geometry.camera import Camera, bearings_from_image
from fieldstone.scene.rays import pixel_centers, rays_from_view
from grid_scenes import FRAME, RADIUS, THIRD_OF_ERROR_DB, ball_photos, plan_of, psnr_of_one_color

PLAN = plan_of(finest=32, steps=(5, 5, 5, 5, 4, 3, 2, 1), num_chunks=4, samples_per_chunk=512)


def training(executor, plan=PLAN, photos=None, **options) -> GridTraining:
    return prepare_grid_training(photos or ball_photos(), FRAME, plan, seed=0, executor=executor, **options)


def run(training, state, steps):
    state, report = training.advance(state)
    for _ in range(steps - 1):
        state, report = training.advance(state)
    return state, report


def same_tensors(a, b):
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def test_a_state_that_was_given_away_is_refused():
    """Its arrays are those of a later step: stepping them again would give neither the same state nor a right one."""
    with ThreadPoolExecutor(1) as executor:
        work = training(executor)
        first = work.start()
        second, _ = work.advance(first)
        with pytest.raises(ValueError, match="after 0 steps was stepped already"):
            work.advance(first)
        third, _ = work.advance(second)
        assert third.step == 2
        with pytest.raises(ValueError, match="after 1 steps was stepped already"):
            work.advance(second)


@pytest.mark.parametrize("immediate_levels", [0, 1])
def test_threads_do_not_change_a_bit(immediate_levels):
    results = []
    plan = PLAN.replaced(immediate_levels=immediate_levels)
    for threads in (1, 2, 5):
        with ThreadPoolExecutor(threads) as executor:
            work = training(executor, plan)
            state, _ = run(work, work.start(), plan.schedule.total_steps)
            results.append(work.to_tensors(state))
    same_tensors(results[0], results[1])
    same_tensors(results[0], results[2])


@pytest.mark.parametrize("stop", [1, 20])
def test_a_stop_does_not_change_a_bit(stop):
    with ThreadPoolExecutor(2) as executor:
        work = training(executor)
        assert isinstance(work, FieldTraining)
        through, _ = run(work, work.start(), PLAN.schedule.total_steps)
        stopped, _ = run(work, work.start(), stop)
        saved = {name: array.copy() for name, array in work.to_tensors(stopped).items()}
        resumed, _ = run(work, work.from_tensors(saved), PLAN.schedule.total_steps - stop)
        same_tensors(work.to_tensors(through), work.to_tensors(resumed))


@pytest.mark.parametrize("stop", [75, 120, 139])
def test_a_stop_before_cells_change_their_size_does_not_change_a_bit(stop):
    """Cells whose new size does not divide the old one reach vertices that had been given up."""
    plan = PLAN.replaced(finest=101, steps=(70, 60, 40, 20, 8, 8, 8, 8))
    with ThreadPoolExecutor(2) as executor:
        work = training(executor, plan, use_alpha=False)
        state, _ = run(work, work.start(), stop)
        saved = {name: array.copy() for name, array in work.to_tensors(state).items()}
        before = state.field.occupancy.cell_size
        through, _ = run(work, state, 155 - stop)
        assert through.field.occupancy.cell_size != before
        resumed, _ = run(work, work.from_tensors(saved), 155 - stop)
        same_tensors(work.to_tensors(through), work.to_tensors(resumed))


@pytest.mark.parametrize("use_alpha", [True, False])
def test_a_ball_is_learned_in_seconds(use_alpha):
    photos = ball_photos(20)
    plan = PLAN.replaced(steps=(20, 20, 20, 20, 20, 10, 5, 5))
    with ThreadPoolExecutor(2) as executor:
        work = training(executor, plan, photos.select(range(1, 20)), use_alpha=use_alpha)
        state, report = run(work, work.start(), plan.schedule.total_steps)
        camera = photos.posed.camera_of(0)
        rendered = work.renderer(state)(rays_from_view(camera, photos.posed.pose_of(0)))
    shown = rendered.rgb.reshape(camera.height, camera.width, 3)
    assert report.mse < 0.01
    assert psnr(shown, photos.composited(0, FRAME.background)) > psnr_of_one_color(photos, 0) + THIRD_OF_ERROR_DB
    center = shown.shape[0] // 2 * camera.width + camera.width // 2
    assert rendered.opacity[center] > 0.95
    assert rendered.opacity[0] < 0.05


def test_a_scene_with_points_is_contracted():
    """Cameras around an object, and points: everything beyond the box is contracted into a shell."""
    photos = ball_photos(20)
    photos = replace(photos, pixels=tuple(rgba[..., :3] * (rgba[..., 3:] // 255) for rgba in photos.pixels))
    points = np.random.default_rng(0).normal(size=(200, 3))
    points *= RADIUS / np.linalg.norm(points, axis=1, keepdims=True)
    dark = replace(FRAME, background=np.zeros(3))
    plan = PLAN.replaced(steps=(20, 20, 20, 20, 20, 10, 5, 5))
    with ThreadPoolExecutor(2) as executor:
        work = prepare_grid_training(
            photos.select(range(1, 20)), dark, plan, seed=0, executor=executor, points_in_world=points, bounded=False
        )
        assert work.space.is_contracted
        state, _ = run(work, work.start(), plan.schedule.total_steps)
        camera = photos.posed.camera_of(0)
        rendered = work.renderer(state)(rays_from_view(camera, photos.posed.pose_of(0)))
    shown = rendered.rgb.reshape(camera.height, camera.width, 3)
    assert psnr(shown, photos.composited(0, dark.background)) > psnr_of_one_color(photos, 0) + THIRD_OF_ERROR_DB
    assert np.all(np.isfinite(rendered.depth))


def test_the_field_survives_saving():
    with ThreadPoolExecutor(1) as executor:
        work = training(executor)
        state, _ = run(work, work.start(), 30)
        rays = rays_from_view(ball_photos().posed.camera_of(0), ball_photos().posed.pose_of(0))
        before = work.renderer(state)(rays)
        again = work.renderer(work.from_tensors(work.to_tensors(state)))(rays)
    np.testing.assert_array_equal(before.rgb, again.rgb)
    np.testing.assert_array_equal(before.depth, again.depth)


def test_samples_stay_in_the_grid_however_often_cells_change_their_size():
    """Cells that do not divide the box reach beyond it; rays must not follow them out of the grids."""
    plan = PLAN.replaced(finest=37)
    with ThreadPoolExecutor(1) as executor:
        work = training(executor, plan, use_alpha=False)
        state = work.start()
        for _ in range(plan.schedule.total_steps):
            state, _ = work.advance(state)
            layout, positions = state.field.layout, state.buffers.samples.position.reshape(-1, 3)
            assert np.all(positions <= layout.extent.astype(np.float32))
            last = (positions[:, None] / layout.spacings[None, :, None]).astype(int) + 1
            assert np.all(last < layout.sizes[None])


def test_unreachable_vertices_are_left_out():
    with ThreadPoolExecutor(1) as executor:
        work = training(executor)
        state, _ = run(work, work.start(), 30)
    vertices = compress(state.field, state.field.table, reachable_vertices(state.field))
    assert 0 < len(vertices) < len(state.field.table) // 4
    again = expand(state.field, vertices)
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    np.testing.assert_array_equal(state.field.density(points), again.density(points))


@pytest.mark.parametrize("name", ["grid", "cells_box", "decoder_hidden_bias", "resolutions"])
def test_a_checkpoint_without_an_array_is_refused(name):
    with ThreadPoolExecutor(1) as executor:
        work = training(executor)
        tensors = work.to_tensors(work.start())
    del tensors[name]
    with pytest.raises(InputError, match="checkpoint"):
        field_from_tensors(tensors)


def test_photos_that_see_nothing_are_refused():
    photos = ball_photos()
    photos = replace(photos, pixels=tuple(np.zeros_like(rgba) for rgba in photos.pixels))
    with ThreadPoolExecutor(1) as executor, pytest.raises(InputError, match="alpha"):
        training(executor, photos=photos)


@pytest.mark.parametrize(("finest", "min_weight"), [(32, 8e-3), (384, 8e-3), (384, 3e-2)])
def test_the_fog_of_the_start_is_seen(finest, min_weight):
    """However short the steps of a grid are, its first samples weigh enough to be learned from."""
    plan = PLAN.replaced(finest=finest, min_weight=min_weight)
    with ThreadPoolExecutor(1) as executor:
        state = training(executor, plan).start()
    march = state.field.march(plan.sampling.min_weight, plan.sampling.early_stop_eps)
    assert -np.expm1(-np.exp(march.density_bias) * march.depth_scale) > 1.15 * min_weight


def test_scouting_finds_the_box_around_the_ball():
    """Without alpha the box of the start is that of the frame; after one stage it is little more than the ball."""
    plan = PLAN.replaced(finest=64, steps=(120, 3, 1, 1, 1, 1, 1, 1))
    with ThreadPoolExecutor(2) as executor:
        work = training(executor, plan, ball_photos(20), use_alpha=False)
        state, _ = run(work, work.start(), 121)
        np.testing.assert_allclose(work.occupancy.extent, 3.0)
        occupancy = state.field.occupancy
        lower, upper = occupancy.lower, occupancy.lower + occupancy.extent
        assert np.all(lower < -RADIUS)
        assert np.all(upper > RADIUS)
        assert np.all(upper - lower < 2.6)
        assert state.step == 121
        assert state.field.layout.resolutions == plan.schedule.levels(1)
        saved = {name: array.copy() for name, array in work.to_tensors(state).items()}
        same_tensors(
            work.to_tensors(run(work, state, 3)[0]), work.to_tensors(run(work, work.from_tensors(saved), 3)[0])
        )


@pytest.mark.parametrize(("focal", "cells"), [(45.0, 12), (200.0, 48), (45.0, 64)])
def test_no_ray_that_meets_a_cell_is_left_out(focal, cells):
    """Whole blocks of pixels are tested by one ray; every pixel that would pass on its own is there."""
    rng = np.random.default_rng(0)
    occupied = np.zeros((cells,) * 3, dtype=bool)
    occupied[tuple(rng.integers(2, cells - 2, (3, 40)))] = True
    occupancy = Occupancy(np.full(3, -1.5), 3.0 / cells, occupied)
    box = occupancy_box(occupancy, occupancy.extent, box_space())
    camera = Camera("SIMPLE_PINHOLE", 81, 50, np.array([focal, 40.5, 25.0]))
    for pose in ball_photos(4, camera).posed.cam_from_world:
        rays = rays_from_view(camera, pose)
        center = rays.origins[0].astype(np.float32)
        expected = np.zeros(len(rays), dtype=np.uint8)
        rays_that_hit(box, center, rays.directions.astype(np.float32), expected)
        bearings = bearings_from_image(camera, pixel_centers(81, 50)).astype(np.float32).reshape(50, 81, 3)
        found = pixels_that_hit(box, center, pose.R.T.astype(np.float32), bearings, focal)
        assert np.all(found.reshape(-1)[expected > 0])
        assert 0 < np.count_nonzero(expected) < found.size
        assert np.count_nonzero(found) < found.size


def test_every_row_is_drawn_once_a_round():
    for count in (1, 2, 7, 1000, 4096):
        stride = coprime_stride(count)
        assert len(set((np.arange(count) * stride % count).tolist())) == count


def test_a_plan_survives_json_and_rates_fall():
    assert plan_from_json(PLAN.to_json()) == PLAN
    shares = [PLAN.rate_multiplier(step) for step in range(PLAN.schedule.total_steps)]
    assert shares[0] == 1.0
    assert np.all(np.diff(shares) < 0)
    assert shares[-1] > PLAN.rates.final_rate_ratio
    with pytest.raises(ValueError, match="plan"):
        plan_from_json('{"finest": 3}')


def test_a_plan_of_before_densities_decayed_means_what_it_meant():
    assert plan_from_json('{"finest": 64, "steps": [1, 1, 1, 1, 1, 1, 1, 1]}').rates.weight_decay == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_chunks": 0},
        {"samples_per_chunk": -1},
        {"min_weight": 0.0},
        {"finest": 64.5},
        {"decay": "x"},
        {"steps": [10.5] * 8},
        {"density_rate": float("nan")},
        {"immediate_levels": -1},
    ],
)
def test_settings_that_make_no_sense_are_named(wrong):
    settings = json.loads(PLAN.to_json()) | wrong
    with pytest.raises(ValueError, match=next(iter(wrong)).replace("steps", "step")):
        plan_from_json(json.dumps(settings))


def test_a_budget_is_shared_out_and_corrected():
    plan = plan_for_budget(PLAN, 10.0, 1.0, 0.01)
    assert 400 < plan.schedule.total_steps < 900
    slower = corrected(plan, 3, 3.0, 0.05)
    assert slower.schedule.steps[:3] == plan.schedule.steps[:3]
    assert sum(slower.schedule.steps[3:]) == pytest.approx(3.0 / 0.05, abs=2)
    assert min(plan_for_budget(PLAN, 0.1, 5.0, 0.01).schedule.steps) == 1


def test_densities_of_fine_levels_give_up_a_share_where_they_move():
    """p loses rate * decay * p, there and nowhere else, besides the step of a plan without decay."""
    steps, first = (1, 1, 5, 1, 1, 1, 1, 1), 3
    plan = plan_of(
        64, steps, num_chunks=4, samples_per_chunk=512, box_warm_up=False, immediate_levels=0, weight_decay=0.0
    )
    fields = {}
    with ThreadPoolExecutor(2) as executor:
        work = training(executor, plan)
        start, _ = run(work, work.start(), first)
        saved = {name: array.copy() for name, array in work.to_tensors(start).items()}
        before = work.from_tensors(saved).field.table.copy()
        for decay in (0.0, 0.5):
            state = work.from_tensors(saved).with_plan(plan.replaced(weight_decay=decay))
            fields[decay] = work.advance(state)[0].field
    layout, rate = fields[0.0].layout, plan.rates.density_rate * plan.rate_multiplier(first)
    assert layout.num_levels == 3
    for level in range(3):
        old, plain, decayed = (layout.level(table, level) for table in (before, fields[0.0].table, fields[0.5].table))
        expected = plain.copy()
        touched = plain[..., 0] != old[..., 0]
        assert touched.any()
        share = (0.0, 0.5 / 1.5, 0.5)[level]
        expected[..., 0] -= np.where(touched, share * rate * old[..., 0], 0)
        np.testing.assert_allclose(decayed, expected, rtol=1e-5, atol=1e-6)
