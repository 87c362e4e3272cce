"""Accuracy over bytes: a panel for each headline, in which evaluations are at their bytes."""

import math
from typing import Any

import pytest
from drawing import texts
from numpy.testing import assert_allclose
from picture_texts import text_faults

from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.evaluation.runs import BytesPoint, OverBytes
from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.evaluation import render_over_bytes

SENT = {"single": 0.0, "some": 900.0, "all": 3000.0}


def report(*headlines: str, sent: dict[str, float] = SENT, **changes: Any) -> OverBytes:
    """Each evaluation is better by 0.1 than the one before."""
    values: dict[str, Any] = {"unit": "share", "low": 0.3, "high": 0.9, **changes}
    points = tuple(
        BytesPoint(evaluation=name, bytes=mean, headline=headline, value=0.5 + row / 10, **values)
        for headline in headlines
        for row, (name, mean) in enumerate(sent.items())
    )
    return OverBytes(
        task="accident", protocol="boxes", samples=1200, resampling=Resampling(), points=points
    )


def drawn(given: OverBytes) -> Any:
    return render_over_bytes(given, fig=detached_figure((10.4, 6.7)))


def ticks(ax: Any) -> dict[float, str]:
    return dict(
        zip(
            ax.get_xticks().tolist(),
            [each.get_text() for each in ax.get_xticklabels()],
            strict=True,
        )
    )


def test_points_are_at_the_logarithm_of_their_bytes_with_their_intervals() -> None:
    fig = drawn(report("apa"))
    ax = fig.axes[0]
    places = [line.get_xydata() for line in ax.lines]
    assert ticks(ax) == {7: "none", 9: "9", 10: "10", 11: "11", 12: "12"}
    for at, value, place in zip(
        (7, math.log2(900), math.log2(3000)), (0.5, 0.6, 0.7), places, strict=True
    ):
        assert_allclose(place, [(at, 0.3), (at, value), (at, 0.9)])
    assert (texts(ax), ax.get_ylabel()) == (["single", "some", "all"], "apa")


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ({"a": 0.0, "b": 0.0}, {-2: "none"}),
        ({"a": 1024.0}, {10: "10"}),
        ({"a": 2.0, "b": 2.0**21}, {1: "1", 6: "6", 11: "11", 16: "16", 21: "21"}),
    ],
    ids=["nobody", "one", "far"],
)
def test_whole_powers_are_named(sent: dict[str, float], expected: dict[float, str]) -> None:
    assert ticks(drawn(report("apa", sent=sent)).axes[0]) == expected


@pytest.mark.parametrize(
    ("place", "panels"), [(None, 4), ("cvpr-page", 4), ("cvpr-column", 2), ("slide", 4)]
)
def test_a_panel_for_each_headline_with_words_that_can_be_read(place: Any, panels: int) -> None:
    with style(place):
        fig = render_over_bytes(report("apa", "precision", "recall", "false_alarm_rate"))
        assert text_faults(fig) == []
    assert [ax.get_ylabel() for ax in fig.axes] == [
        "apa",
        "precision",
        "recall",
        "false_alarm_rate",
    ][:panels]
