"""Figures of statistics: every group of them, and their files."""

from pathlib import Path

import pytest
from drawing import new_axes
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
    draw_relative_positions,
    render_statistics,
    save_statistics,
)
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics


@pytest.mark.slow
def test_every_group_is_drawn_on_the_figure_given(
    statistics: DatasetStatistics, da: DeepAccident
) -> None:
    nothing = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        figure = detached_figure((10, 8))
        assert render_statistics(statistics, group, fig=figure) is figure
        assert [ax for ax in figure.axes if not ax.get_title()] == []
        render_statistics(nothing, group, fig=detached_figure((10, 8))).canvas.draw()
    angles = statistics.histograms["collision_angles"]
    assert_refused(
        (
            lambda: render_statistics(statistics, "weather"),
            ChoiceError,
            ("scenarios, ends, ego", "'weather'"),
        ),
        (lambda: draw_angles(angles, ax=figure.add_subplot()), ChoiceError, ("polar axes",)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("group", STATISTICS_FIGURES)
def test_words_are_apart_and_large(statistics: DatasetStatistics, group: str) -> None:
    assert text_faults(render_statistics(statistics, group)) == []


@pytest.mark.slow
def test_files_are_the_same_bytes_each_time(statistics: DatasetStatistics, tmp_path: Path) -> None:
    first, second = (
        {path.name: path.read_bytes() for path in save_statistics(statistics, tmp_path / name)}
        for name in ("a", "b")
    )
    assert first == second
    assert (len(first), min(map(len, first.values())) > 5000) == (2 * len(STATISTICS_FIGURES), True)
    assert sorted(first) == sorted(path.name for path in (tmp_path / "a").iterdir())
    file = next((tmp_path / "a").iterdir())
    assert_refused(
        (lambda: save_statistics(statistics, file), ConfigError, ("is a file", "give a folder"))
    )


def test_bars_add_up_to_the_counts(statistics: DatasetStatistics) -> None:
    table, histogram = statistics.counts["weathers"], statistics.histograms["distances"]
    ax = detached_figure((4, 3)).add_subplot()
    assert draw_counts(table, ax=ax) is ax
    assert (
        sum(bar.get_width() for bar in ax.patches) == table.total() == statistics.scenarios["total"]
    )
    ax = draw_histogram(histogram, new_axes())
    assert sum(bar.get_height() for bar in ax.patches) == sum(histogram.counts["total"])
    ax = draw_relative_positions(statistics.collisions, new_axes())
    assert sum(len(points.get_offsets()) for points in ax.collections) == len(statistics.collisions)
