"""Panels put values where their borders say, ticks are round, dots and pictures have the size that was asked for."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest

from drawn_figures import vertices
from fieldstone.report import svg
from fieldstone.report.panel import Panel, ticks, whole_ticks
from fieldstone.report.raster import color_ramp, dimmed, dots_on_ground, encode_jpeg, small
from fieldstone.report.theme import DARK, LIGHT


def test_a_panel_maps_borders_to_borders_and_ratios_to_lengths():
    panel = Panel(10.0, 20.0, 300.0, 100.0, x=(0.01, 100.0), y=(2.0, -3.0), log_x=True)
    corners = panel.place(np.array([[0.01, 2.0], [100.0, -3.0]]))
    np.testing.assert_allclose(corners, [[10.0, 120.0], [310.0, 20.0]])
    powers = panel.place(np.stack([np.logspace(-2, 2, 5), np.linspace(2.0, -3.0, 5)], axis=1))
    np.testing.assert_allclose(np.diff(powers, axis=0), np.broadcast_to([75.0, -25.0], (4, 2)))


@pytest.mark.parametrize("count", [3, 4, 8, 12])
def test_ticks_are_round_inside_and_neither_few_nor_many(count):
    rng = np.random.default_rng(0)
    for _ in range(300):
        span = 10.0 ** rng.uniform(-5, 5)
        low = rng.normal() * span * 10.0 ** rng.integers(-2, 3)
        marks = np.array(ticks((low, low + span), count=count))
        assert np.all((marks >= low - 1e-6 * span) & (marks <= low + span * (1 + 1e-6)))
        assert len(marks) > count / 2.5 - 1
        if len(marks) < 2:
            continue  # one multiple of a step of nearly the whole span
        step = np.diff(marks)
        np.testing.assert_allclose(step, step[0], rtol=1e-4)
        assert span / count * (1 - 1e-6) <= step[0] <= 2.5 * span / count * (1 + 1e-6)
        digits = step[0] / 10.0 ** np.floor(np.log10(step[0]) + 1e-4)
        assert min(abs(digits - m) for m in (1, 2, 5)) < 1e-3
        assert np.all(np.abs(marks / step[0] - np.round(marks / step[0])) < 1e-3)


def test_ticks_of_odd_limits():
    assert ticks((3.0, 3.0)) == [3.0]
    assert ticks((0.01, 100.0), log=True) == [0.01, 0.1, 1.0, 10.0, 100.0]
    assert ticks((1.0, -1.0), count=2) == [-1.0, 0.0, 1.0]
    assert whole_ticks((0.0, 2.2)) == [0.0, 1.0, 2.0]


def test_names_cannot_break_out_of_a_figure():
    nasty = "</text><script>alert(1)</script>\"' & <![CDATA[ ]]> \x00\x1b\udcff"
    root = ET.fromstring(svg.page(10.0, 10.0, LIGHT, [svg.text((1.0, 2.0), nasty, LIGHT.ink)]))
    assert [e.tag.split("}")[1] for e in root.iter()] == ["svg", "rect", "text"]
    assert "".join(root.itertext()).startswith("</text><script>alert(1)</script>\"' & <![CDATA[ ]]> □□□")


def test_what_is_not_finite_or_far_away_does_not_reach_the_page():
    points = np.array([[1.0, 2.0], [np.nan, 1.0], [np.inf, 0.0], [1e300, -1e300], [-0.001, 3.14159]])
    path = ET.fromstring(svg.dots(points, DARK.ink, 2.0, "d"))
    np.testing.assert_array_equal(vertices(path), [[1.0, 2.0], [1e5, -1e5], [0.0, 3.14]])
    assert "nan" not in svg.segments(np.array([[[np.nan, 1.0], [2.0, 3.0]]]), DARK.ink, 1.0, "s")


@pytest.mark.parametrize("diameter", [3.0, 6.4, 12.0, 17.6])
def test_dots_cover_their_disc(diameter):
    areas = []
    for shift in np.random.default_rng(0).uniform(0, 1, (40, 2)):
        dot = dots_on_ground(
            20 + shift[None], np.array([diameter]), np.full((1, 3), 255, dtype=np.uint8), (40, 44), (0, 0, 0)
        )[:, :, 0].astype(float)
        areas.append(dot.sum() / 255)
        rows, columns = np.mgrid[:44, :40] + 0.5
        middle = [(columns * dot).sum() / dot.sum(), (rows * dot).sum() / dot.sum()]
        np.testing.assert_allclose(middle, 20 + shift, atol=0.15)
    assert 2 * np.sqrt(np.mean(areas) / np.pi) == pytest.approx(diameter, abs=0.5)  # OpenCV rounds the rim


def test_later_dots_cover_earlier_ones_and_odd_places_are_left_out():
    centers = np.array([[5.0, 5.0], [5.0, 5.0], [np.nan, 1.0], [1e300, 2.0], [-1e9, 4.0]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [9, 9, 9], [9, 9, 9], [9, 9, 9]], dtype=np.uint8)
    shown = dots_on_ground(centers, np.full(5, 4.0), colors, (10, 8), (1, 2, 3))
    assert shown.shape == (8, 10, 3)
    np.testing.assert_array_equal(shown[5, 5], [0, 255, 0])
    np.testing.assert_array_equal(shown[0, 9], [1, 2, 3])
    assert not np.any(np.all(shown == 9, axis=2))


def test_shrinking_keeps_the_mean_colour():
    photo = np.random.default_rng(0).integers(0, 256, size=(400, 600, 3), dtype=np.uint8)
    shrunk = small(photo, 60)
    assert shrunk.shape == (40, 60, 3)
    np.testing.assert_allclose(shrunk.mean(axis=(0, 1)), photo.mean(axis=(0, 1)), atol=1.0)
    assert small(shrunk, 100) is shrunk
    np.testing.assert_allclose(dimmed(shrunk, 0.6), 0.6 * shrunk.astype(float), atol=1.0)


def test_a_ramp_runs_from_its_first_to_its_last_colour():
    ramp = color_ramp(np.array([-1.0, 0.0, 0.5, 1.0, 7.0]), cv2.COLORMAP_INFERNO).astype(int)
    np.testing.assert_array_equal(ramp[0], ramp[1])
    np.testing.assert_array_equal(ramp[3], ramp[4])
    assert ramp[1].sum() < ramp[2].sum() < ramp[3].sum()
    assert ramp[2, 0] > ramp[2, 2]  # red in the middle: channels are in the order R, G, B


def test_encoding_twice_gives_the_same_bytes_and_no_date():
    photo = np.random.default_rng(0).integers(0, 256, size=(30, 40, 3), dtype=np.uint8)
    assert encode_jpeg(photo) == encode_jpeg(photo.copy())
    assert b"Exif" not in encode_jpeg(photo)
