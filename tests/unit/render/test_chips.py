"""Chips cover neither each other nor what must stay free, at any size of the figure."""

from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from drawing import has_color, new_axes, on_canvas, rendered
from matplotlib.axes import Axes

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.arrays import FloatArray
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.axes import settled
from deepaccident_devkit.render.chips import keep_free, place_chips
from deepaccident_devkit.render.colors import MUTED_COLOR
from deepaccident_devkit.v2x import Link, PoseNoise

CAR = np.array([[2.3, 1.0], [2.3, -1.0], [-2.3, -1.0], [-2.3, 1.0]])


def new_view() -> Axes:
    ax: Axes = new_axes()
    ax.set(xlim=(-40, 40), ylim=(-40, 40), aspect="equal")
    return ax


def shown(ax: Axes) -> list[FloatArray]:
    """The chips that are rendered: left, low, right, high, pixels."""
    return [np.array(each.get_window_extent().extents) for each in ax.texts if each.get_visible()]


def cover(one: FloatArray, other: FloatArray) -> bool:
    return bool((one[:2] < other[2:]).all() and (other[:2] < one[2:]).all())


@pytest.mark.parametrize("seed", range(12))
def test_chips_cover_neither_each_other_nor_cars_nor_the_frame(seed: int) -> None:
    centers = np.random.default_rng(seed).uniform(-40, 40, (40, 2))
    cars, ax = centers[:, None] + CAR, new_view()
    place_chips(ax, [(str(20_000 + number), center) for number, center in enumerate(centers)], avoid=cars)
    for dpi in (60, 110):
        rendered(ax, dpi)
        chips = shown(ax)
        assert len(chips) >= 36
        assert not any(cover(one, other) for one, other in combinations(chips, 2))
        places = ax.transData.transform(cars.reshape(-1, 2)).reshape(-1, 4, 2)
        bounds = np.concatenate([places.min(axis=1), places.max(axis=1)], axis=1)
        assert not any(cover(chip, car) for chip in chips for car in bounds)
        assert all((chip[:2] >= ax.bbox.min).all() and (chip[2:] <= ax.bbox.max).all() for chip in chips)


def test_calls_on_the_same_axes_know_of_each_other() -> None:
    ax = new_view()
    place_chips(ax, [("ego", (0.0, 0.0))])
    place_chips(ax, [("other", (0.0, 0.0))])
    keep_free(ax, CAR[None])
    rendered(ax)
    first, second = shown(ax)
    assert not cover(first, second)
    places = ax.transData.transform(CAR)
    assert not any(cover(chip, np.concatenate([places.min(axis=0), places.max(axis=0)])) for chip in (first, second))


def test_a_chip_without_room_or_place_is_left_out_and_the_first_ones_stay() -> None:
    ax = new_view()
    place_chips(ax, [("here", (0.0, 0.0)), ("outside", (50.0, 0.0)), ("x" * 200, (5.0, 5.0))])
    rendered(ax)
    assert [each.get_visible() for each in ax.texts] == [True, False, False]
    ax.set_xlim(20, 60)
    rendered(ax)
    assert [each.get_visible() for each in ax.texts] == [False, True, False]


def test_a_line_leads_to_a_chip_that_is_far_away() -> None:
    for size, led in ((1, False), (14, True)):
        ax = new_view()
        place_chips(ax, [("ego", (0.0, 0.0))], avoid=[CAR * size])
        picture = rendered(ax, 300)
        assert has_color(picture, on_canvas(ax, [(0.0, 0.0)])[0], MUTED_COLOR) == led


ALL = ("boxes", "ids", "velocities")
LINK = Link(pose_noise=PoseNoise(mean=1.0, std=0.2))
VIEWS: dict[str, Callable[[DeepAccident, Any, Any], object]] = {
    "bev": lambda da, sample, fig: da.render_bev(sample, agents=None, layers=ALL, ax=fig.add_subplot()),
    "visibility": lambda da, sample, fig: da.render_visibility(
        sample, layers=("boxes", "ids", "visibility"), ax=fig.add_subplot()
    ),
    "link": lambda da, sample, fig: da.render_link(sample, LINK, layers=("boxes", "ids"), fig=fig),
    "labels": lambda da, sample, fig: da.render_motion_labels(sample, style="trail", layers=("labels", "ids"), fig=fig),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
def test_in_twelve_scenes_no_words_are_cut_and_no_two_cover_each_other(da: DeepAccident, name: str) -> None:
    samples = [sample for sample in da.sample if sample["labelled"] and sample["agent"] == "ego_vehicle"]
    for number in np.random.default_rng(0).permutation(len(samples))[:12]:
        fig: Any = detached_figure((6, 6.9) if name != "link" else (9, 10))
        VIEWS[name](da, samples[number], fig)
        settled(fig, passes=3).draw_without_rendering()  # as it is saved
        for ax in fig.axes:
            chips = shown(ax)
            assert not any(cover(one, other) for one, other in combinations(chips, 2))
            assert all((chip[:2] >= ax.bbox.min).all() and (chip[2:] <= ax.bbox.max).all() for chip in chips)
            legend = ax.get_legend().get_texts() if ax.get_legend() else []
            words = [word for word in (ax.title, ax.xaxis.label, ax.yaxis.label, *legend) if word.get_text()]
            bounds = np.array([word.get_window_extent().extents for word in words]).reshape(-1, 4)
            assert (bounds[:, :2] >= 0).all()
            assert (bounds[:, 2:] <= fig.bbox.max).all()
