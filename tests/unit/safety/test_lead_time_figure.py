import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.safety import COALITIONS, ObservationRule, lead_time_ledger
from deepaccident_devkit.safety.figures import render_lead_times


def test_bars_are_the_means(da_b: DeepAccident) -> None:
    ledger = lead_time_ledger(da_b, rule=ObservationRule(kind="points"))
    figure = render_lead_times(ledger)
    members, leads, shapley = figure.axes
    order = sorted(range(16), key=lambda number: (len(COALITIONS[number]), number))
    widths = [bar.get_width() for bar in leads.patches]
    assert widths == pytest.approx([ledger.mean_leads[number].mean for number in order])
    assert [bar.get_width() for bar in shapley.patches] == pytest.approx([mean.mean for mean in ledger.mean_shapley])
    dots = [line for line in members.lines if line.get_color() != "none"]
    assert len(dots) == sum(map(len, COALITIONS))
    rows = [line.get_ydata()[0] for line in dots if line.get_xdata()[0] == 4]
    assert rows == [row for row, number in enumerate(order) if "infrastructure" in COALITIONS[number]]
    assert "it is no prediction" in figure.get_supxlabel()


def test_a_given_figure_is_used_and_nothing_is_no_picture(da_b: DeepAccident) -> None:
    figure = Figure(layout="constrained")
    ledger = lead_time_ledger(da_b)
    assert render_lead_times(ledger, fig=figure) is figure
    assert not plt.get_fignums()
    with pytest.raises(NotAvailableError, match="no accident whose lead times can be told"):
        render_lead_times(lead_time_ledger(da_b, da_b.find(collision=False)))
