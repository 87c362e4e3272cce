"""Figures of statistics: what is drawn, on whose axes, and the files."""

from pathlib import Path

import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.statistics import STATISTICS_FIGURES, render_statistics, save_statistics
from deepaccident_devkit.render.statistics_panels import (
    render_angles,
    render_counts,
    render_histogram,
    render_quantiles,
    render_relative_positions,
)
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics


@pytest.fixture(scope="module")
def statistics(da: DeepAccident) -> DatasetStatistics:
    return dataset_statistics(da)


def test_bars_add_up_to_the_counts(statistics: DatasetStatistics) -> None:
    table = statistics.counts["weathers"]
    ax = detached_figure((4, 3)).add_subplot()
    assert render_counts(table, ax=ax) is ax
    assert sum(bar.get_width() for bar in ax.patches) == table.total() == statistics.scenarios["total"]
    assert [label.get_text() for label in ax.get_yticklabels()] == list(table.counts)
    histogram = statistics.histograms["distances"]
    ax = render_histogram(histogram)
    assert sum(bar.get_height() for bar in ax.patches) == sum(histogram.counts["total"])
    assert ax.get_xlabel() == "distance (m)"
    ax = render_angles(statistics.histograms["collision_angles"])
    assert sum(bar.get_height() for bar in ax.patches) == len(statistics.collisions)
    ax = render_relative_positions(statistics.collisions)
    assert sum(len(points.get_offsets()) for points in ax.collections) == len(statistics.collisions)
    assert render_quantiles(statistics.quantiles["box_sizes"], "width").get_ylabel() == "width (m)"


def test_every_group_is_drawn_on_the_figure_given(statistics: DatasetStatistics) -> None:
    for group in STATISTICS_FIGURES:
        figure = detached_figure((10, 8))
        assert render_statistics(statistics, group, fig=figure) is figure
        assert all(ax.get_title() for ax in figure.axes)
    with pytest.raises(ChoiceError, match="expected one of scenarios, ends, ego"):
        render_statistics(statistics, "weather")
    with pytest.raises(ChoiceError, match="expected polar axes"):
        render_angles(statistics.histograms["collision_angles"], ax=figure.add_subplot())


def test_files_are_the_same_bytes_each_time(statistics: DatasetStatistics, tmp_path: Path) -> None:
    first = save_statistics(statistics, tmp_path / "a")
    second = save_statistics(statistics, tmp_path / "b", formats=("pdf", "png"))
    assert len(first) == 2 * len(STATISTICS_FIGURES)
    assert sorted(path.name for path in first) == sorted(path.name for path in (tmp_path / "a").iterdir())
    for path in second:
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes(), path
        assert path.stat().st_size > 5000
    with pytest.raises(ChoiceError, match="expected some of png, pdf, found 'svg'"):
        save_statistics(statistics, tmp_path, formats=("svg",))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="is a file; give a folder"):
        save_statistics(statistics, first[0])


def test_an_empty_selection_is_drawn(da: DeepAccident) -> None:
    nothing = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        render_statistics(nothing, group, fig=detached_figure((10, 8))).canvas.draw()
