from dataclasses import replace

import pytest
from picture_texts import text_faults

from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.baselines import Panel, render_panel, render_panels
from deepaccident_devkit.render.colors import CONFIGURATION_COLORS
from deepaccident_devkit.v2x import AGENT_CONFIGS

BARS = Panel(
    values={"single": {"visible": 0.5, "invisible": None}, "all": {"visible": 0.75, "invisible": 1.0}},
    title="APA",
    ylabel="APA",
    top=1.0,
)
LINES = Panel(
    values={"+infrastructure": {0.0: 90.0, 0.1: None, 0.5: 40.0}, "all": {0.0: 95.0, 0.5: 50.0}},
    title="IoU",
    ylabel="IoU (%)",
    top=100.0,
    xlabel="latency (s)",
)


def test_bars_stand_side_by_side_and_none_where_there_is_no_number() -> None:
    ax = render_panel(BARS, ax=detached_figure((3, 3)).subplots())
    assert [label.get_text() for label in ax.get_xticklabels()] == ["visible", "invisible"]
    heights = [[bar.get_height() for bar in bars] for bars in ax.containers]  # type: ignore[attr-defined]
    assert heights == [[0.5], [0.75, 1.0]]
    first, second = (bars[0] for bars in ax.containers)  # type: ignore[index]
    assert first.get_x() + first.get_width() <= second.get_x() + 1e-9
    assert ax.get_ylim() == pytest.approx((0, 1.04))


def test_lines_go_over_the_number_that_is_varied() -> None:
    ax = render_panel(LINES, ax=detached_figure((3, 3)).subplots())
    first, second = ax.get_lines()
    assert list(first.get_xdata()) == [0.0, 0.5]
    assert list(second.get_ydata()) == [95.0, 50.0]
    assert first.get_linestyle() != second.get_linestyle()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("latency (s)", "IoU (%)")


@pytest.mark.parametrize(("panel", "place"), [(BARS, "visible"), (LINES, 0.5)])
def test_intervals_stand_at_their_numbers(panel: Panel, place: str | float) -> None:
    given = replace(panel, intervals={"all": {place: (0.25, 0.9)}})
    ax = render_panel(given, ax=detached_figure((3, 3)).subplots())
    drawn = [segment for lines in ax.collections for segment in lines.get_segments()]  # type: ignore[attr-defined]
    assert [segment[:, 1].tolist() for segment in drawn] == [[0.25, 0.9]]
    bar = ax.containers[1][0] if panel is BARS else None  # type: ignore[index]
    assert drawn[0][0, 0] == pytest.approx(bar.get_x() + bar.get_width() / 2 if bar else place)


def test_panels_share_a_title_and_a_legend() -> None:
    figure = render_panels([[BARS, BARS], [LINES, LINES]], "both", fig=detached_figure((6, 6)))
    assert len(figure.axes) == 4
    assert figure.get_suptitle() == "both"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["single", "all"]


@pytest.mark.slow
def test_words_of_all_configurations_are_apart() -> None:
    bars = replace(BARS, values=dict.fromkeys(AGENT_CONFIGS, BARS.values["all"]))
    lines = replace(LINES, values=dict.fromkeys(AGENT_CONFIGS, LINES.values["all"]))
    for columns in (1, 2, 5):
        figure = render_panels([[bars] * columns, [lines] * columns], "accuracy")
        assert text_faults(figure) == []
        drawn = figure.get_tightbbox()
        assert min(*drawn.min, *(figure.get_size_inches() - drawn.max)) > -0.01


def test_the_papers_configurations_have_colours_of_their_own() -> None:
    assert CONFIGURATION_COLORS.keys() == AGENT_CONFIGS.keys()
    assert len(set(CONFIGURATION_COLORS.values())) == len(AGENT_CONFIGS)
