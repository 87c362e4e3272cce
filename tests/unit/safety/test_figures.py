"""The figure of avoidability: its lines are the report's numbers, its words legible."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure
from picture_texts import text_faults
from refusals import assert_refused
from replayed_accidents import head_on, rear_end

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.render.figures import detached_figure
from deepaccident_devkit.safety import (
    COALITIONS,
    OUTCOMES,
    AvoidabilityReport,
    ObservationRule,
    avoidability_of,
    lead_time_ledger,
)
from deepaccident_devkit.safety.figures import render_avoidability, render_lead_times


def report_of(*accidents: object) -> AvoidabilityReport:
    return AvoidabilityReport(dataroot="/data", version="v1", accidents=accidents, dropped=(), skipped=(), margins={})


@pytest.fixture(scope="module")
def report() -> AvoidabilityReport:
    return report_of(
        avoidability_of(rear_end(20, 10)), avoidability_of(rear_end(20, 14, 2)), avoidability_of(head_on(9, 2))
    )


def test_lines_are_the_shares(report: AvoidabilityReport) -> None:
    figure = detached_figure((10, 6))
    assert render_avoidability(report, fig=figure) is figure
    avoided, speeds = figure.axes[:4], figure.axes[4:]
    warned = ("the first brakes", "the second brakes", "both brake", "the ego brakes")
    assert [ax.get_title() for ax in avoided] == [f"{who} (2)" for who in warned]
    shares = report.shares[0]
    for column, (one, two) in enumerate(zip(avoided[0].lines, speeds[0].lines, strict=True)):
        enough = slice(0, len(one.get_xdata()))
        np.testing.assert_allclose(one.get_ydata(), shares.shares[enough, column, OUTCOMES.index("avoided")])
        np.testing.assert_allclose(two.get_ydata(), shares.relative_speed[enough, column])
    looks = {(line.get_color(), line.get_linestyle()) for line in avoided[0].lines}
    assert (len(looks), len(avoided[0].lines)) == (9, 9)
    assert avoided[0].lines[0].get_xdata()[-1] == pytest.approx(5)


def test_a_line_ends_where_few_recordings_are_long_enough() -> None:
    short = [avoidability_of(rear_end(20, 14, 2)) for _ in range(2)]
    figure = render_avoidability(report_of(avoidability_of(rear_end(20, 10)), *short), fig=detached_figure((10, 6)))
    assert figure.axes[0].lines[0].get_xdata()[-1] == pytest.approx(2)


def test_groups_without_accidents(report: AvoidabilityReport) -> None:
    assert len(render_avoidability(report, "head-on", fig=detached_figure((10, 6))).axes) == 8
    assert_refused(
        (lambda: render_avoidability(report, "pedestrians"), NotAvailableError, ("no accident", "'pedestrians'")),
        (lambda: render_avoidability(report, "trucks"), ChoiceError, ("group", "vehicles, head-on, pedestrians")),
    )


@pytest.mark.slow
def test_words_are_apart_and_large(report: AvoidabilityReport) -> None:
    assert text_faults(render_avoidability(report)) == []


def test_bars_are_the_means(da_b: DeepAccident) -> None:
    ledger, figure = lead_time_ledger(da_b, rule=ObservationRule(kind="points")), Figure(layout="constrained")
    assert render_lead_times(ledger, fig=figure) is figure
    members, leads, shapley = figure.axes
    order = sorted(range(16), key=lambda number: (len(COALITIONS[number]), number))
    for ax, means in ((leads, [ledger.mean_leads[number] for number in order]), (shapley, ledger.mean_shapley)):
        assert [bar.get_width() for bar in ax.patches] == pytest.approx([each.mean for each in means])
    dots = [tuple(line.get_xydata()[0]) for line in members.lines if line.get_color() != "none"]
    assert len(dots) == sum(map(len, COALITIONS))
    poles = [row for row, number in enumerate(order) if "infrastructure" in COALITIONS[number]]
    assert [row for column, row in dots if column == 4] == poles
    assert "it is no prediction" in figure.get_supxlabel()
    assert not plt.get_fignums()
    nothing = lead_time_ledger(da_b, da_b.find(collision=False))
    assert_refused((lambda: render_lead_times(nothing), NotAvailableError, ("no accident",)))
