"""Figures of statistics: every group of them, and their files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawing import new_axes
from matplotlib.markers import MarkerStyle
from picture_texts import text_faults
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.statistics import (
    STATISTICS_FIGURES,
    draw_angles,
    draw_counts,
    draw_histogram,
    draw_quantiles,
    draw_relative_positions,
    render_statistics,
    save_statistics,
)
from deepaccident_devkit.render.styles import CATEGORY_MARKERS
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics
from deepaccident_devkit.taxonomy import CATEGORIES


@pytest.mark.slow
def test_every_group_is_drawn_on_the_figure_given(statistics: DatasetStatistics, da: DeepAccident) -> None:
    nothing = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        figure = detached_figure((10, 8))
        assert render_statistics(statistics, group, fig=figure) is figure
        assert [ax for ax in figure.axes if not ax.get_title()] == []
        render_statistics(nothing, group, fig=detached_figure((10, 8))).canvas.draw()
    angles = statistics.histograms["collision_angles"]
    assert_refused(
        (lambda: render_statistics(statistics, "weather"), ChoiceError, ("scenarios, ends, ego", "'weather'")),
        (lambda: draw_angles(angles, ax=figure.add_subplot()), ChoiceError, ("polar axes",)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("group", STATISTICS_FIGURES)
def test_words_are_apart_and_large(statistics: DatasetStatistics, group: str) -> None:
    assert text_faults(render_statistics(statistics, group)) == []


@pytest.mark.slow
def test_files_are_the_same_bytes_each_time(statistics: DatasetStatistics, tmp_path: Path) -> None:
    first, second = (
        {path.name: path.read_bytes() for path in save_statistics(statistics, tmp_path / name)} for name in ("a", "b")
    )
    assert first == second
    assert (len(first), min(map(len, first.values())) > 5000) == (2 * len(STATISTICS_FIGURES), True)
    assert sorted(first) == sorted(path.name for path in (tmp_path / "a").iterdir())
    file = next((tmp_path / "a").iterdir())
    assert_refused((lambda: save_statistics(statistics, file), ConfigError, ("is a file", "give a folder")))


def test_bars_add_up_to_the_counts(statistics: DatasetStatistics) -> None:
    table, histogram = statistics.counts["weathers"], statistics.histograms["distances"]
    ax = detached_figure((4, 3)).add_subplot()
    assert draw_counts(table, ax=ax) is ax
    assert sum(bar.get_width() for bar in ax.patches) == table.total() == statistics.scenarios["total"]
    assert [label.get_text() for label in ax.get_yticklabels()] == list(table.counts)
    ax = draw_histogram(histogram, new_axes())
    assert sum(bar.get_height() for bar in ax.patches) == sum(histogram.counts["total"])
    assert ax.get_xlabel() == "distance (m)"
    ax = draw_relative_positions(statistics.collisions, new_axes())
    assert sum(len(points.get_offsets()) for points in ax.collections) == len(statistics.collisions)
    assert draw_quantiles(statistics.quantiles["box_sizes"], "width", new_axes()).get_ylabel() == "width (m)"


def test_the_numbers_of_the_circles_lie_beside_the_bars(statistics: DatasetStatistics) -> None:
    angles = statistics.histograms["collision_angles"]
    ax = draw_angles(angles, detached_figure((4, 3)).add_subplot(projection="polar"))
    assert sum(bar.get_height() for bar in ax.patches) == len(statistics.collisions)
    place = [edge % 360 for edge in angles.edges].index(round(ax.get_rlabel_position(), 6) % 360)
    assert angles.counts["total"][place - 1] + angles.counts["total"][place] == 0


def test_classes_have_their_marks(statistics: DatasetStatistics) -> None:
    pairs = [replace(statistics.collisions[0], other_category=category) for category in CATEGORIES]
    drawn = draw_relative_positions(pairs, ax=detached_figure((5, 5)).add_subplot()).collections
    assert [str(points.get_label()) for points in drawn] == list(CATEGORIES)
    for points, category in zip(drawn, CATEGORIES, strict=True):
        mark = MarkerStyle(CATEGORY_MARKERS.get(category, "s"))
        shape = mark.get_path().transformed(mark.get_transform()).vertices
        assert np.array_equal(points.get_paths()[0].vertices, shape), category
