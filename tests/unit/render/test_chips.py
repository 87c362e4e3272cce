"""Chips cover neither each other nor what must stay free, at any size of the figure."""

from itertools import combinations, product

import numpy as np
import pytest
from drawing import has_color, new_axes, on_canvas, rendered
from matplotlib.axes import Axes

from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.styles import MUTED_COLOR
from deepaccident_devkit.support.arrays import FloatArray

CAR = np.array([[2.3, 1.0], [2.3, -1.0], [-2.3, -1.0], [-2.3, 1.0]])


def bounds_of(ax: Axes, corners: FloatArray) -> list[FloatArray]:
    """Left, low, right, high, pixels, of cars (N, 4, 2)."""
    places = ax.transData.transform(corners.reshape(-1, 2)).reshape(-1, 4, 2)
    return [*np.concatenate([places.min(axis=1), places.max(axis=1)], axis=1)]


def new_view() -> Axes:
    ax: Axes = new_axes()
    ax.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal")
    return ax


def shown(ax: Axes) -> list[FloatArray]:
    """The chips that are rendered: left, low, right, high, pixels."""
    return [np.array(each.get_window_extent().extents) for each in ax.texts if each.get_visible()]


def cover(one: FloatArray, other: FloatArray) -> bool:
    return bool((one[:2] < other[2:]).all() and (other[:2] < one[2:]).all())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_chips_cover_neither_each_other_nor_cars_nor_the_frame(seed: int) -> None:
    centers = np.random.default_rng(seed).uniform(-40, 40, (40, 2))
    cars, ax = centers[:, None] + CAR, new_view()
    place_chips(
        ax, [(str(20_000 + number), center) for number, center in enumerate(centers)], avoid=cars
    )
    for dpi in (60, 110):
        rendered(ax, dpi)
        chips = shown(ax)
        assert len(chips) >= 36
        pairs = [*combinations(chips, 2), *product(chips, bounds_of(ax, cars))]
        assert [pair for pair in pairs if cover(*pair)] == []
        assert all(
            (chip[:2] >= ax.bbox.min).all() and (chip[2:] <= ax.bbox.max).all() for chip in chips
        )


def test_calls_on_the_same_axes_know_of_each_other() -> None:
    ax = new_view()
    for name in ("ego", "other"):
        place_chips(ax, [(name, (0.0, 0.0))])
    keep_free(ax, CAR[None])
    rendered(ax)
    first, second = shown(ax)
    assert [
        pair for pair in combinations([first, second, *bounds_of(ax, CAR)], 2) if cover(*pair)
    ] == []


def test_a_chip_without_room_or_place_is_left_out_and_the_first_ones_stay() -> None:
    ax = new_view()
    place_chips(ax, [("here", (0.0, 0.0)), ("outside", (50.0, 0.0)), ("x" * 200, (5.0, 5.0))])
    for left, right, visible in ((-40, 40, [True, False, False]), (20, 60, [False, True, False])):
        ax.set_xlim(left, right)
        rendered(ax)
        assert [each.get_visible() for each in ax.texts] == visible


def test_a_line_leads_to_a_chip_that_is_far_away() -> None:
    for size, led in ((1, False), (14, True)):
        ax = new_view()
        place_chips(ax, [("ego", (0.0, 0.0))], avoid=[CAR * size])
        assert has_color(rendered(ax, 300), on_canvas(ax, [(0.0, 0.0)])[0], MUTED_COLOR) == led
