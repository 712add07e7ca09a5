"""Charts show the numbers they are given."""

from __future__ import annotations

import numpy as np
import pytest

from drawn_figures import drawn, in_panel, pixels, positions, vertices, words
from fieldstone.records.field import CurvePoint
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
from fieldstone.report.theme import DARK, LIGHT, evenly, label, readable_colors
from fieldstone.scene.mapping_run import StageRecord
from fieldstone.scene.tracks import Observations
from fieldstone.synthetic.scenes import SceneOptions, synthesize


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
        panel = 0 if drawn(figure, stage, 0) else 1
        heights = in_panel(figure, vertices(drawn(figure, stage, panel)[0]), panel)[:, 1]
        assert len(heights) == 2 * 49
        np.testing.assert_allclose(heights[1:-1:2], heights[2::2])
        assert heights[1:-1:2].sum() == pytest.approx(99, abs=0.5)  # the outermost bins hold what is beyond them
    assert not drawn(figure, "linear triangulation")


def test_match_matrix_holds_putative_counts_above_and_inliers_below():
    graph = synthesize(
        SceneOptions(num_cameras=4, outlier_share=0.3, topology="sequential", num_neighbors=1), np.random.default_rng(0)
    ).verified_graph()
    counts = match_counts(graph)
    assert counts[0, 1] == len(graph.matches[0, 1])
    assert counts[1, 0] == graph.two_views[0, 1].inliers.sum() < counts[0, 1]
    assert counts[0, 3] == counts[3, 0] == 0
    figure = match_matrix_figure(graph)
    assert sorted(words(figure, "count")) == sorted(str(c) for c in counts.ravel() if c)
    cells = pixels(drawn(figure, "cells")[0]).astype(int)
    assert cells.shape == (4, 4, 3)
    np.testing.assert_array_equal(np.all(cells == 255, axis=2), counts == 0)
    by_count = np.argsort(counts, axis=None)
    assert np.all(np.diff(cells.sum(axis=2).ravel()[by_count]) <= 0)  # more matches, darker


def test_match_matrix_of_many_photos_has_a_scale_instead_of_numbers():
    graph = synthesize(SceneOptions(num_cameras=14, num_points=40), np.random.default_rng(0)).verified_graph()
    figure = match_matrix_figure(graph, theme=DARK)
    assert not drawn(figure, "count")
    assert len(drawn(figure, "ramp")) == 1
    assert pixels(drawn(figure, "cells")[0]).shape == (14, 14, 3)


def test_track_lengths_are_counted():
    point = np.repeat(np.arange(4), [2, 5, 2, 3])
    observations = Observations(np.zeros(12, dtype=int), np.zeros(12, dtype=int), point, np.zeros((12, 2)))
    figure = track_lengths_figure(observations)
    assert words(figure, "count") == ["2", "1", "0", "1"]
    heights = [float(bar.get("height", "")) for bar in drawn(figure, "lengths")]
    np.testing.assert_allclose(np.array(heights) / heights[1], [2, 1, 0, 1], atol=1e-3)
    assert words(track_lengths_figure(Observations.empty()), "count") == ["0"]


def test_training_curve_leaves_out_what_is_not_a_number():
    nan = float("nan")
    curve = [
        CurvePoint(0, 0.5, -1.0, nan),
        CurvePoint(1, 1.0, nan, 12.0),
        CurvePoint(2, 2.0, -2.0, 13.5),
        CurvePoint(3, 3.0, nan, float("inf")),
    ]
    figure = training_figure(curve)
    np.testing.assert_allclose(positions(figure, "loss-values", 0), [[0.5, -1.0], [2.0, -2.0]], atol=1e-3)
    np.testing.assert_allclose(positions(figure, "psnr-values", 1), [[1.0, 12.0], [2.0, 13.5]], atol=1e-3)
    assert words(training_figure([CurvePoint(0, 1.0, nan, nan)]), "text").count("not recorded") == 2


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
    shown = drawn(figure, "view")
    assert len(shown) == 6
    for k, image in enumerate((true, rendered, difference_image(true, rendered), rendered, true)):
        assert np.abs(pixels(shown[k]).mean(axis=(0, 1)) - image.mean(axis=(0, 1))).max() < 2.0  # stored as JPEG
        assert np.corrcoef(pixels(shown[k]).mean(axis=2).ravel(), image.mean(axis=2).ravel())[0, 1] > 0.97
    assert [float(e.get("x", "")) for e in shown[:3]] == sorted(float(e.get("x", "")) for e in shown[:3])
    assert "20.00 dB" in words(figure)[1]
    with pytest.raises(ValueError, match="'a' is"):
        rendered_views_figure([("a", true, rendered[:10], "")])
    with pytest.raises(ValueError, match="at least one"):
        rendered_views_figure([])


def test_labels_are_one_visible_line():
    assert label("plain.png") == "plain.png"
    assert label("a\nb\x00照\u202e\udcff.png") == "a□b□照□□.png"
    assert label("holiday_2026_" + "x" * 40 + "_0017.jpg", 20) == "holiday_2…x_0017.jpg"


def test_evenly_keeps_both_ends():
    np.testing.assert_array_equal(evenly(3, 5), [0, 1, 2])
    np.testing.assert_array_equal(evenly(11, 3), [0, 5, 10])
    assert len(evenly(0, 3)) == 0


def test_colours_keep_apart_from_the_ground():
    rgb = np.array([[255, 255, 255], [0, 0, 0], [120, 130, 140]], dtype=np.uint8)
    on_light, on_dark = readable_colors(rgb, LIGHT), readable_colors(rgb, DARK)
    assert on_light[0].max() < 0.75 * 255
    assert on_dark[1].min() > 0.2 * 255
    for colors in (on_light, on_dark):
        np.testing.assert_array_equal(colors[2], rgb[2])
