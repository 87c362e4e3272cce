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
def test_every_group_is_drawn_on_the_figure_given(statistics: DatasetStatistics) -> None:
    for group in STATISTICS_FIGURES:
        figure = detached_figure((10, 8))
        assert render_statistics(statistics, group, fig=figure) is figure
        assert all(ax.get_title() for ax in figure.axes)
    assert_refused(
        (lambda: render_statistics(statistics, "weather"), ChoiceError, "expected one of scenarios, ends, ego"),
        (
            lambda: draw_angles(statistics.histograms["collision_angles"], ax=figure.add_subplot()),
            ChoiceError,
            "expected polar axes",
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("group", STATISTICS_FIGURES)
def test_words_are_apart_and_large(statistics: DatasetStatistics, group: str) -> None:
    assert text_faults(render_statistics(statistics, group)) == []


@pytest.mark.slow
def test_files_are_the_same_bytes_each_time(statistics: DatasetStatistics, tmp_path: Path) -> None:
    first = save_statistics(statistics, tmp_path / "a")
    second = save_statistics(statistics, tmp_path / "b")
    assert len(first) == 2 * len(STATISTICS_FIGURES)
    assert sorted(path.name for path in first) == sorted(path.name for path in (tmp_path / "a").iterdir())
    for path in second:
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes(), path
        assert path.stat().st_size > 5000
    with pytest.raises(ConfigError, match="is a file; give a folder"):
        save_statistics(statistics, first[0])


@pytest.mark.slow
def test_an_empty_selection_is_drawn(da: DeepAccident) -> None:
    nothing = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        render_statistics(nothing, group, fig=detached_figure((10, 8))).canvas.draw()


def test_bars_add_up_to_the_counts(statistics: DatasetStatistics) -> None:
    table = statistics.counts["weathers"]
    ax = detached_figure((4, 3)).add_subplot()
    assert draw_counts(table, ax=ax) is ax
    assert sum(bar.get_width() for bar in ax.patches) == table.total() == statistics.scenarios["total"]
    assert [label.get_text() for label in ax.get_yticklabels()] == list(table.counts)
    histogram = statistics.histograms["distances"]
    ax = draw_histogram(histogram, new_axes())
    assert sum(bar.get_height() for bar in ax.patches) == sum(histogram.counts["total"])
    assert ax.get_xlabel() == "distance (m)"
    angles = statistics.histograms["collision_angles"]
    ax = draw_angles(angles, detached_figure((4, 3)).add_subplot(projection="polar"))
    assert sum(bar.get_height() for bar in ax.patches) == len(statistics.collisions)
    counts, place = (
        angles.counts["total"],
        [edge % 360 for edge in angles.edges].index(round(ax.get_rlabel_position(), 6) % 360),
    )
    assert counts[place - 1] + counts[place] == 0  # the numbers of the circles lie beside the bars
    ax = draw_relative_positions(statistics.collisions, new_axes())
    assert sum(len(points.get_offsets()) for points in ax.collections) == len(statistics.collisions)
    assert draw_quantiles(statistics.quantiles["box_sizes"], "width", new_axes()).get_ylabel() == "width (m)"


def test_classes_have_their_marks(statistics: DatasetStatistics) -> None:
    pairs = [replace(statistics.collisions[0], other_category=category) for category in CATEGORIES]
    drawn = draw_relative_positions(pairs, ax=detached_figure((5, 5)).add_subplot()).collections
    assert [str(points.get_label()) for points in drawn] == list(CATEGORIES)
    for points, category in zip(drawn, CATEGORIES, strict=True):
        mark = MarkerStyle(CATEGORY_MARKERS.get(category, "s"))
        shape = mark.get_path().transformed(mark.get_transform()).vertices
        assert np.array_equal(points.get_paths()[0].vertices, shape), category
