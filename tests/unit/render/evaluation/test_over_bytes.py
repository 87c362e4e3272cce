"""Accuracy over bytes: each headline has a panel, with the evaluations at their bytes."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.figure_texts import STYLES, find_text_faults
from support.rendered_pixels import read_texts

from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.evaluation import render_over_bytes
from deepaccident_devkit.render.styles import current_style

BYTES_SENT = {"single": 0.0, "some": 900.0, "all": 3000.0}


def make_report(
    *headlines: str, bytes_sent: dict[str, float] = BYTES_SENT, **changes: Any
) -> OverBytes:
    """Make a report in which each evaluation is better by 0.1 than the one before."""
    values: dict[str, Any] = {"unit": "share", "low": 0.3, "high": 0.9, **changes}
    points = tuple(
        BytesPoint(evaluation=name, bytes=mean, headline=headline, value=0.5 + row / 10, **values)
        for headline in headlines
        for row, (name, mean) in enumerate(bytes_sent.items())
    )
    return OverBytes(
        task="accident", protocol="boxes", samples=1200, resampling=Resampling(), points=points
    )


def draw_report(report: OverBytes) -> Any:
    return render_over_bytes(report, fig=detached_figure((10.4, 6.7)))


def read_tick_sizes(ax: Any) -> dict[str, float]:
    """Return the label of each tick with the number of bytes where it is drawn."""
    labels = [label.get_text() for label in ax.get_xticklabels()]
    return dict(zip(labels, np.exp2(ax.get_xticks()).tolist(), strict=True))


def test_points_are_at_the_logarithm_of_their_bytes_with_their_intervals() -> None:
    ax = draw_report(make_report("apa")).axes[0]
    ticks = {"none": 2**7, "512 B": 512, "1 kB": 1000, "2 kB": 2000, "4 kB": 4000}
    assert read_tick_sizes(ax) == pytest.approx(ticks)

    expected_points = ((7, 0.5), (math.log2(900), 0.6), (math.log2(3000), 0.7))
    for line, (x, value) in zip(ax.lines, expected_points, strict=True):
        assert_allclose(line.get_xydata(), [(x, 0.3), (x, value), (x, 0.9)])
    assert (read_texts(ax), ax.get_ylabel()) == (["single", "some", "all"], "APA")


@pytest.mark.parametrize(
    ("bytes_sent", "expected"),
    [
        ({"a": 0.0, "b": 0.0}, {"none": 1}),
        ({"a": 1000.0}, {"1 kB": 1000}),
        (
            {"a": 2.0, "b": 2e6},
            {"2 B": 2, "64 B": 64, "2 kB": 2000, "64 kB": 64000, "2 MB": 2e6},
        ),
    ],
    ids=["nobody", "one", "far"],
)
def test_sizes_are_named_in_units(bytes_sent: dict[str, float], expected: dict[str, float]) -> None:
    fig = draw_report(make_report("apa", bytes_sent=bytes_sent))
    assert read_tick_sizes(fig.axes[0]) == pytest.approx(expected)


@pytest.mark.parametrize("medium", STYLES)
def test_a_panel_for_each_headline_with_words_that_can_be_read(medium: Any) -> None:
    headlines = ["apa", "precision", "recall", "false_alarm_rate"]
    with style(medium):
        fig = render_over_bytes(make_report(*headlines))
        assert find_text_faults(fig) == []
        num_panels = 2 if current_style().layout == "column" else 4
    names = ["APA", "precision", "recall", "false alarm rate"]
    assert [ax.get_ylabel() for ax in fig.axes] == names[:num_panels]
