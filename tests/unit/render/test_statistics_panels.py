"""Panels of statistics: what they draw is what was counted."""

from dataclasses import replace

import numpy as np
from drawing import new_axes
from matplotlib.markers import MarkerStyle

from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.statistics import (
    draw_angles,
    draw_counts,
    draw_histogram,
    draw_quantiles,
    draw_relative_positions,
)
from deepaccident_devkit.render.styles import CATEGORY_MARKERS
from deepaccident_devkit.statistics import DatasetStatistics
from deepaccident_devkit.taxonomy import CATEGORIES


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
