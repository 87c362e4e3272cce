"""Figures of statistics: every group of them, and their files."""

from pathlib import Path

import pytest
from picture_texts import text_faults
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.statistics import STATISTICS_FIGURES, draw_angles, render_statistics, save_statistics
from deepaccident_devkit.statistics import DatasetStatistics, dataset_statistics

pytestmark = pytest.mark.slow


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


@pytest.mark.parametrize("group", STATISTICS_FIGURES)
def test_words_are_apart_and_large(statistics: DatasetStatistics, group: str) -> None:
    assert text_faults(render_statistics(statistics, group)) == []


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


def test_an_empty_selection_is_drawn(da: DeepAccident) -> None:
    nothing = dataset_statistics(da, [])
    for group in STATISTICS_FIGURES:
        render_statistics(nothing, group, fig=detached_figure((10, 8))).canvas.draw()
