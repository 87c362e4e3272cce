"""The figures of safety: their cells and dots are the report's numbers, their words legible."""

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from picture_texts import panels_share, text_faults
from refusals import assert_refused
from replayed_accidents import head_on, rear_end

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import OUTCOMES
from deepaccident_devkit.descriptions import ObservationRule, avoidability_of
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.plugins.safety import COALITIONS, AvoidabilityReport, lead_time_ledger
from deepaccident_devkit.plugins.safety.figures import render_avoidability, render_lead_times
from deepaccident_devkit.render import detached_figure, style


def report_of(*accidents: object) -> AvoidabilityReport:
    return AvoidabilityReport(
        dataroot="/data", version="v1", accidents=accidents, dropped=(), skipped=(), margins={}
    )


@pytest.fixture(scope="module")
def report() -> AvoidabilityReport:
    return report_of(
        avoidability_of(rear_end(20, 10)),
        avoidability_of(rear_end(20, 14, 2)),
        avoidability_of(head_on(9, 2)),
    )


def test_cells_are_the_shares(report: AvoidabilityReport) -> None:
    figure = detached_figure((10, 6))
    assert render_avoidability(report, fig=figure) is figure
    avoided, speeds = figure.axes[:4], figure.axes[4:8]
    warned = ("the first brakes", "the second brakes", "both brake", "the ego brakes")
    assert [ax.get_title() for ax in avoided] == [f"{who} (2)" for who in warned]
    shares = report.shares[0]
    one, two = (ax.images[0].get_array() for ax in (avoided[0], speeds[0]))
    np.testing.assert_allclose(one.T, shares.shares[: one.shape[1], :, OUTCOMES.index("avoided")])
    np.testing.assert_allclose(two.T, shares.relative_speed[: two.shape[1]])
    assert [label.get_text() for label in avoided[0].get_yticklabels()][::8] == [
        "0.5 s, 4 m/s²",
        "1.5 s, 8 m/s²",
    ]
    assert avoided[0].images[0].get_extent() == pytest.approx((-0.05, 5.05, 8.5, -0.5))


def test_cells_end_where_few_recordings_are_long_enough() -> None:
    short = [avoidability_of(rear_end(20, 14, 2)) for _ in range(2)]
    figure = render_avoidability(
        report_of(avoidability_of(rear_end(20, 10)), *short), fig=detached_figure((10, 6))
    )
    assert figure.axes[0].images[0].get_extent()[1] == pytest.approx(2.05)


def test_groups_without_accidents(report: AvoidabilityReport) -> None:
    assert len(render_avoidability(report, "head-on", fig=detached_figure((10, 6))).axes) == 8 + 2
    assert_refused(
        (
            lambda: render_avoidability(report, "pedestrians"),
            NotAvailableError,
            ("no accident", "'pedestrians'"),
        ),
        (
            lambda: render_avoidability(report, "trucks"),
            ChoiceError,
            ("group", "vehicles, head-on, pedestrians"),
        ),
    )


@pytest.mark.slow
@pytest.mark.parametrize("place", [None, "paper", "cvpr-column", "slide"])
def test_words_are_apart_and_large(
    report: AvoidabilityReport, da_b: DeepAccident, place: Any
) -> None:
    with style(place):
        for figure in (render_avoidability(report), render_lead_times(lead_time_ledger(da_b))):
            assert text_faults(figure) == []
            assert panels_share(figure) > 0.35


def test_dots_are_the_means(da_b: DeepAccident) -> None:
    ledger, figure = (
        lead_time_ledger(da_b, rule=ObservationRule(kind="points")),
        Figure(layout="constrained"),
    )
    assert render_lead_times(ledger, fig=figure) is figure
    _, leads, shapley = figure.axes

    def mean_of(number: int) -> float:
        return float(ledger.mean_leads[number].mean or 0)

    longest = [
        max((each for each in range(16) if len(COALITIONS[each]) == size), key=mean_of)
        for size in (3, 4, 5)
    ]
    order = [0, 1, 2, 4, 8, *longest]
    for ax, means in (
        (leads, [ledger.mean_leads[number] for number in order]),
        (shapley, ledger.mean_shapley),
    ):
        found = [line.get_xdata()[0] for line in ax.lines if line.get_marker() == "o"]
        assert found == pytest.approx([each.mean for each in means])
    nothing = lead_time_ledger(da_b, da_b.find(collision=False))
    assert_refused((lambda: render_lead_times(nothing), NotAvailableError, ("no accident",)))
