"""The figures of safety: cells and dots show the report's numbers, and the words are legible."""

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.braking_accidents import head_on_accident, rear_end_accident
from support.expected_errors import assert_raises
from support.figure_texts import STYLES, find_text_faults, panel_area_ratio

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import OUTCOMES
from deepaccident_devkit.descriptions import ObservationRule, avoidability_of
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.plugins.safety import COALITIONS, AvoidabilityReport, lead_time_ledger
from deepaccident_devkit.plugins.safety.figures import render_avoidability, render_lead_times
from deepaccident_devkit.render import detached_figure, style


def make_report(*accidents: object) -> AvoidabilityReport:
    return AvoidabilityReport(
        dataroot="/data", version="v1", accidents=accidents, dropped=(), skipped=(), margins={}
    )


@pytest.fixture(scope="module")
def report() -> AvoidabilityReport:
    return make_report(
        avoidability_of(rear_end_accident(20, 10)),
        avoidability_of(rear_end_accident(20, 14, 2)),
        avoidability_of(head_on_accident(9, 2)),
    )


def test_cells_are_the_shares(report: AvoidabilityReport) -> None:
    figure = detached_figure((10, 6))
    assert render_avoidability(report, fig=figure) is figure

    avoided_axes, speed_axes = figure.axes[:4], figure.axes[4:8]
    assert [ax.get_title() for ax in avoided_axes] == [
        "only actor 1 brakes (n = 2)",
        "only actor 2 brakes (n = 2)",
        "both actors brake (n = 2)",
        "only the ego brakes (n = 2)",
    ]

    shares = report.shares[0]
    avoided = avoided_axes[0].images[0].get_array().T
    speeds = speed_axes[0].images[0].get_array().T
    expected_avoided = shares.shares[: len(avoided), :, OUTCOMES.index("avoided")]
    np.testing.assert_allclose(avoided, expected_avoided)
    np.testing.assert_allclose(speeds, shares.relative_speed[: len(speeds)])

    labels = [label.get_text() for label in avoided_axes[0].get_yticklabels()]
    assert labels[::8] == [
        "0.5 s, 4 m/s²",
        "1.5 s, 8 m/s²",
    ]
    extent = avoided_axes[0].images[0].get_extent()
    assert extent == pytest.approx((-0.05, 5.05, 8.5, -0.5))


def test_cells_end_where_few_recordings_are_long_enough() -> None:
    report = make_report(
        avoidability_of(rear_end_accident(20, 10)),
        avoidability_of(rear_end_accident(20, 14, 2)),
        avoidability_of(rear_end_accident(20, 14, 2)),
    )
    figure = render_avoidability(report, fig=detached_figure((10, 6)))

    assert figure.axes[0].images[0].get_extent()[1] == pytest.approx(2.05)


def test_groups_without_accidents(report: AvoidabilityReport) -> None:
    figure = render_avoidability(report, "head-on", fig=detached_figure((10, 6)))
    assert len(figure.axes) == 8 + 2
    assert_raises(
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
@pytest.mark.parametrize("medium", STYLES)
def test_words_are_apart_and_large(
    report: AvoidabilityReport, da_b: DeepAccident, medium: Any
) -> None:
    with style(medium):
        for figure in (
            render_avoidability(report),
            render_lead_times(lead_time_ledger(da_b)),
        ):
            assert find_text_faults(figure) == []
            assert panel_area_ratio(figure) > 0.35


def test_dots_are_the_means(da_b: DeepAccident) -> None:
    ledger = lead_time_ledger(da_b, rule=ObservationRule(kind="points"))
    figure = Figure(layout="constrained")
    assert render_lead_times(ledger, fig=figure) is figure

    def mean_lead(number: int) -> float:
        return float(ledger.mean_leads[number].mean or 0)

    longest = []
    for size in (3, 4, 5):
        numbers = [number for number in range(16) if len(COALITIONS[number]) == size]
        longest.append(max(numbers, key=mean_lead))
    expected_leads = [ledger.mean_leads[number] for number in (0, 1, 2, 4, 8, *longest)]

    _, lead_axes, shapley_axes = figure.axes
    for ax, means in (
        (lead_axes, expected_leads),
        (shapley_axes, ledger.mean_shapley),
    ):
        dots = [line.get_xdata()[0] for line in ax.lines if line.get_marker() == "o"]
        assert dots == pytest.approx([mean.mean for mean in means])

    nothing = lead_time_ledger(da_b, da_b.find(collision=False))
    assert_raises(
        (lambda: render_lead_times(nothing), NotAvailableError, ("no accident",)),
    )
