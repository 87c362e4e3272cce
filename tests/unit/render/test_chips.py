"""Chips cover neither each other nor what must stay free, at any size of the figure."""

from collections.abc import Iterable
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from support.rendered_pixels import canvas_positions, has_color, new_axes, render_canvas

from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.styles import MUTED_COLOR
from deepaccident_devkit.support.arrays import FloatArray

CAR_CORNERS = np.array([[2.3, 1.0], [2.3, -1.0], [-2.3, -1.0], [-2.3, 1.0]])


def measure_cars(ax: Axes, corners: FloatArray) -> list[FloatArray]:
    """Return left, low, right and high, in pixels, of cars with these corners (N, 4, 2)."""
    pixels = ax.transData.transform(corners.reshape(-1, 2)).reshape(-1, 4, 2)
    bounds = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)
    return [*bounds]


def new_view() -> Axes:
    ax: Axes = new_axes()
    ax.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal")
    return ax


def measure_chips(ax: Axes) -> list[FloatArray]:
    """Return left, low, right and high, in pixels, of the chips that are rendered."""
    return [np.array(text.get_window_extent().extents) for text in ax.texts if text.get_visible()]


def find_overlaps(pairs: Iterable[tuple[FloatArray, FloatArray]]) -> list[Any]:
    """Return the pairs of bounds that overlap."""
    return [
        (first, second)
        for first, second in pairs
        if (first[:2] < second[2:]).all() and (second[:2] < first[2:]).all()
    ]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_chips_cover_neither_each_other_nor_cars_nor_the_frame(seed: int) -> None:
    centers = np.random.default_rng(seed).uniform(-40, 40, (40, 2))
    cars = centers[:, None] + CAR_CORNERS
    labels = [(str(20_000 + number), center) for number, center in enumerate(centers)]
    ax = new_view()

    place_chips(ax, labels, avoid=cars)

    for dpi in (60, 110):
        render_canvas(ax, dpi)
        chips = measure_chips(ax)
        assert len(chips) >= 36
        assert find_overlaps(combinations(chips, 2)) == []
        assert find_overlaps(product(chips, measure_cars(ax, cars))) == []
        for chip in chips:
            assert (chip[:2] >= ax.bbox.min).all()
            assert (chip[2:] <= ax.bbox.max).all()


def test_chips_of_later_calls_avoid_the_ones_of_earlier_calls() -> None:
    ax = new_view()
    for name in ("ego", "other"):
        place_chips(ax, [(name, (0.0, 0.0))])
    keep_free(ax, CAR_CORNERS[None])
    render_canvas(ax)

    first, second = measure_chips(ax)
    shapes = [first, second, *measure_cars(ax, CAR_CORNERS)]
    assert find_overlaps(combinations(shapes, 2)) == []


def test_a_chip_without_room_is_left_out_and_the_first_ones_stay() -> None:
    ax = new_view()
    place_chips(ax, [("here", (0.0, 0.0)), ("outside", (50.0, 0.0)), ("x" * 200, (5.0, 5.0))])
    for left, right, visible in ((-40, 40, [True, False, False]), (20, 60, [False, True, False])):
        ax.set_xlim(left, right)
        render_canvas(ax)
        assert [text.get_visible() for text in ax.texts] == visible


def test_a_line_leads_to_a_chip_that_is_far_away() -> None:
    for car_scale, has_line in ((1, False), (14, True)):
        ax = new_view()
        place_chips(ax, [("ego", (0.0, 0.0))], avoid=[CAR_CORNERS * car_scale])
        canvas = render_canvas(ax, 300)
        (position,) = canvas_positions(ax, [(0.0, 0.0)])
        assert has_color(canvas, position, MUTED_COLOR) == has_line
