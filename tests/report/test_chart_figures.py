"""Charts show the numbers they are given."""

from __future__ import annotations

import numpy as np
import pytest

from fieldstone.mapping.record import StageRecord
from fieldstone.report.chart_figures import (
    DIFFERENCE_GAIN,
    difference_image,
    error_histograms_figure,
    match_counts,
    match_matrix_figure,
    rendered_views_figure,
    track_lengths_figure,
    training_figure,
)
from fieldstone.report.theme import DARK, LIGHT, drawn_pixels, encode_png, evenly, label, readable_colors, small
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import SceneOptions, synthesize
from figure_artists import drawn


def test_error_histograms_count_every_observation_in_front():
    rng = np.random.default_rng(0)
    records = []
    for stage, scale in (("linear PnP", 20.0), ("PnP RANSAC", 2.0), ("non-linear PnP", 1e-4), ("after BA", 500.0)):
        for view in range(2):
            pixels = rng.uniform(0, 500, (50, 2))
            reprojected = pixels + scale * rng.normal(size=(50, 2))
            reprojected[:view] = np.nan
            records.append(StageRecord(stage, view, f"{view}.png", pixels, reprojected))
    figure = error_histograms_figure(records)
    for stage in ("linear PnP", "PnP RANSAC", "non-linear PnP", "after BA"):
        (steps,) = drawn(figure, stage)
        assert steps.get_data().values.sum() == 99  # too small and too large errors count in the outermost bins
    assert not drawn(figure, "linear triangulation")


def test_match_matrix_holds_putative_counts_above_and_inliers_below():
    graph = synthesize(
        SceneOptions(num_cameras=4, outlier_share=0.3, topology="sequential", num_neighbors=1), np.random.default_rng(0)
    ).verified_graph()
    counts = match_counts(graph)
    assert counts[0, 1] == len(graph.matches[0, 1])
    assert counts[1, 0] == graph.two_views[0, 1].inliers.sum() < counts[0, 1]
    assert counts[0, 3] == counts[3, 0] == 0
    texts = {t.get_text() for t in match_matrix_figure(graph).axes[0].texts}
    assert texts == {str(c) for c in counts.ravel() if c}


def test_track_lengths_are_counted():
    point = np.repeat(np.arange(4), [2, 5, 2, 3])
    observations = Observations(np.zeros(12, dtype=int), np.zeros(12, dtype=int), point, np.zeros((12, 2)))
    (axes,) = track_lengths_figure(observations).axes
    bars = axes.containers[0].patches  # pyright: ignore[reportAttributeAccessIssue]
    assert {round(b.get_x() + b.get_width() / 2): b.get_height() for b in bars} == {2: 2, 3: 1, 4: 0, 5: 1}
    drawn_pixels(track_lengths_figure(Observations.empty()))


def test_training_curve_leaves_out_what_is_not_a_number():
    curve = [
        {"step": 0, "seconds": 0.5, "loss": -1.0},
        {"step": 1, "seconds": 1.0, "loss": float("nan"), "psnr": 12.0},
        {"step": 2, "seconds": 2.0, "loss": -2.0, "psnr": 13.5},
        {"step": 3, "seconds": 3.0, "loss": None, "psnr": float("inf")},
    ]
    figure = training_figure(curve)
    (loss,), (psnr,) = drawn(figure, "loss"), drawn(figure, "psnr")
    np.testing.assert_array_equal(loss.get_xydata(), [[0.5, -1.0], [2.0, -2.0]])
    np.testing.assert_array_equal(psnr.get_xydata(), [[1.0, 12.0], [2.0, 13.5]])
    drawn_pixels(training_figure([{"seconds": 1.0}, {"loss": 3.0}]))


def test_difference_is_black_where_views_agree_and_grows_with_the_error():
    true = np.full((4, 6, 3), 100, dtype=np.uint8)
    rendered = true.copy()
    rendered[1, 2] = 110
    rendered[3, 5] = 255
    image = difference_image(true, rendered).astype(int).sum(axis=2)
    assert (image == image[0, 0]).sum() == 22
    assert image[0, 0] < 10 < image[1, 2] < image[3, 5]
    # The gain is undone: a difference of 1 / gain is the brightest there is.
    saturated = difference_image(true, (true + round(255 / DIFFERENCE_GAIN)).astype(np.uint8))
    np.testing.assert_array_equal(saturated[0, 0], difference_image(true, np.full_like(true, 255))[0, 0])


def test_rendered_views_stand_beside_the_true_ones():
    rng = np.random.default_rng(0)
    true, rendered = rng.integers(0, 256, size=(2, 20, 30, 3), dtype=np.uint8)
    figure = rendered_views_figure([("r_0.png", true, rendered, "20.00 dB"), ("r_1.png", rendered, true, "")])
    shown = [axes.images[0].get_array() for axes in figure.axes]
    for k, image in enumerate((true, rendered, difference_image(true, rendered), rendered, true)):
        np.testing.assert_array_equal(shown[k], image)
    assert "20.00 dB" in figure.axes[1].get_title(loc="left")
    with pytest.raises(ValueError, match="'a' is"):
        rendered_views_figure([("a", true, rendered[:10], "")])
    with pytest.raises(ValueError, match="at least one"):
        rendered_views_figure([])


def test_the_same_figure_gives_the_same_bytes():
    curve = [{"seconds": float(k), "loss": -float(k), "psnr": 10.0 + k} for k in range(5)]
    first, second = (encode_png(training_figure(curve)) for _ in range(2))
    assert first == second
    assert b"tEXt" not in first  # no date and no program in it


def test_labels_are_one_line_of_known_glyphs():
    assert label("plain.png") == "plain.png"
    assert label("a\nb\x00照.png") == "a□b□□.png"
    assert label("holiday_2026_" + "x" * 40 + "_0017.jpg", 20) == "holiday_2…x_0017.jpg"


def test_evenly_keeps_both_ends():
    np.testing.assert_array_equal(evenly(3, 5), [0, 1, 2])
    np.testing.assert_array_equal(evenly(11, 3), [0, 5, 10])
    assert len(evenly(0, 3)) == 0


def test_shrinking_keeps_the_mean_colour():
    photo = np.random.default_rng(0).integers(0, 256, size=(400, 600, 3), dtype=np.uint8)
    shrunk = small(photo, 60)
    assert shrunk.shape == (40, 60, 3)
    np.testing.assert_allclose(shrunk.mean(axis=(0, 1)), photo.mean(axis=(0, 1)), atol=1.0)
    assert small(shrunk, 100) is shrunk


def test_colours_keep_apart_from_the_ground():
    rgb = np.array([[255, 255, 255], [0, 0, 0], [120, 130, 140]], dtype=np.uint8)
    on_light, on_dark = readable_colors(rgb, LIGHT), readable_colors(rgb, DARK)
    assert on_light[0].max() < 0.75
    assert on_dark[1].min() > 0.2
    for colors in (on_light, on_dark):
        np.testing.assert_allclose(colors[2], rgb[2] / 255)
