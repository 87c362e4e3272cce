"""Figures of statistics: every group of them, and their files."""

from pathlib import Path
from typing import Any

import pytest
from matplotlib import pyplot as plt
from support.expected_errors import assert_raises
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import new_axes

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.statistics import (
    STATISTICS_FIGURES,
    draw_angles,
    draw_counts,
    draw_histogram,
    draw_relative_positions,
    render_statistics,
    save_statistics,
)
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics


@pytest.mark.slow
def test_every_group_is_drawn_on_the_figure_given(
    statistics: DatasetStatistics, da: DeepAccident
) -> None:
    empty = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        figure = detached_figure((10, 8))
        assert render_statistics(statistics, group, fig=figure) is figure
        assert [ax for ax in figure.axes if not ax.get_title()] == []
        render_statistics(empty, group, fig=detached_figure((10, 8))).canvas.draw()

    angles = statistics.histograms["collision_angles"]
    assert_raises(
        (
            lambda: render_statistics(statistics, "weather"),
            ChoiceError,
            ("scenarios, ends, ego", "'weather'"),
        ),
        (lambda: draw_angles(angles, ax=figure.add_subplot()), ChoiceError, ("polar axes",)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("medium", STYLES)
@pytest.mark.parametrize("group", STATISTICS_FIGURES)
def test_words_are_apart_and_large(statistics: DatasetStatistics, group: str, medium: Any) -> None:
    with style(medium):
        figure = render_statistics(statistics, group)
        assert find_text_faults(figure) == []
    plt.close(figure)


@pytest.mark.slow
def test_files_are_the_same_bytes_each_time(statistics: DatasetStatistics, tmp_path: Path) -> None:
    first, second = (
        {path.name: path.read_bytes() for path in save_statistics(statistics, tmp_path / folder)}
        for folder in ("a", "b")
    )
    assert first == second
    assert len(first) == 2 * len(STATISTICS_FIGURES)
    assert min(map(len, first.values())) > 5000
    files = [*(tmp_path / "a").iterdir()]
    assert sorted(first) == sorted(file.name for file in files)

    assert_raises(
        (lambda: save_statistics(statistics, files[0]), ConfigError, ("is a file", "give a folder"))
    )


def test_bars_add_up_to_the_counts(statistics: DatasetStatistics) -> None:
    table = statistics.counts["weathers"]
    ax = detached_figure((4, 3)).add_subplot()
    assert draw_counts(table, ax=ax) is ax
    sum_of_bars = sum(bar.get_width() for bar in ax.patches)
    assert sum_of_bars == table.total() == statistics.scenarios["total"]

    histogram = statistics.histograms["distances"]
    ax = draw_histogram(histogram, new_axes())
    assert sum(bar.get_height() for bar in ax.patches) == sum(histogram.counts["total"])

    collisions = statistics.collisions
    ax = draw_relative_positions(collisions, new_axes())
    assert sum(len(points.get_offsets()) for points in ax.collections) == len(collisions)
