"""Curves of a training run: a panel for each number, and a file that is written whole or not at
all.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from support.figure_texts import STYLES, find_text_faults

from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.training import render_curve, render_training, save_training


def make_log(num_steps: int) -> list[dict]:
    """Make a log with two losses at each step, and two scores at every fourth."""
    log = []
    for step in range(1, num_steps + 1):
        row = {
            "step": step,
            "loss": 3.0,
            "losses": {"seg": 2.0 / step, "flow": 1.0 + step},
            "rate": 0.1,
        }
        if step % 4 == 0:
            row["validation"] = {"iou": step / 100, "score": 0.5}
        log.append(row)
    return log


def test_each_number_has_a_panel() -> None:
    figure = detached_figure((10, 5))

    assert render_training(make_log(8), "a run", fig=figure) is figure
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == ["total", "seg", "flow", "validation: IoU", "validation: score", ""]
    dots, line = figure.axes[3].get_lines()
    for curve in (dots, line):
        np.testing.assert_allclose(curve.get_xydata(), [[4, 0.04], [8, 0.08]])


def test_a_loss_of_nothing_is_a_gap() -> None:
    losses = [1.0, 1.0, 0.0, 0.0, 1.0, 1.0]
    log = [{"step": step, "losses": {"seg": loss}} for step, loss in enumerate(losses, start=1)]
    ax = render_training(log, "a run", fig=detached_figure((10, 3))).axes[0]
    dots, line = ax.get_lines()
    assert np.isnan(dots.get_ydata()).tolist() == [False, False, True, True, False, False]
    assert line.get_xdata().tolist() == [1, 2, 5, 6]


def test_the_total_has_no_dip_where_a_loss_is_not_computed() -> None:
    """A loss that no step computes leaves the total as it is."""
    flows = [2.0, 0.0, 2.0]
    log = [
        {"step": step, "loss": 1.0 + flow, "losses": {"seg": 1.0, "flow": flow, "unused": 0.0}}
        for step, flow in enumerate(flows, start=1)
    ]
    ax = render_training(log, "a run", fig=detached_figure((10, 3))).axes[0]
    assert ax.get_title() == "total"
    np.testing.assert_array_equal(ax.get_lines()[0].get_ydata(), [3.0, np.nan, 3.0])


def test_many_steps_are_averaged() -> None:
    """All steps have a dot, and averaging does not change the mean."""
    values = np.random.default_rng(0).normal(2.0, 1.0, 600)
    ax = render_curve(range(600), values, "loss", ax=detached_figure((3, 2)).subplots())
    _, line = ax.get_lines()
    assert len(line.get_xydata()) == 60
    assert line.get_ydata().mean() == pytest.approx(values.mean())
    np.testing.assert_allclose(line.get_xydata()[0], [4.5, values[:10].mean()])


@pytest.mark.parametrize("log", [[], [{"step": 1, "losses": {"seg": 1.0}}], [{"step": 3}]])
def test_short_logs_are_drawn(log: list[dict], tmp_path: Path) -> None:
    with style("ieee-page"):
        save_training(log, "begun", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


@pytest.mark.parametrize("medium", STYLES)
def test_words_are_apart_and_large(medium: Any) -> None:
    log = make_log(12)
    for row in log:
        row["losses"] |= dict.fromkeys(("motion_segmentation", "motion_centerness"), 1.0)
        row.setdefault("validation", {}).update(iou_100x100=40.0, vpq_100x100=30.0)
    with style(medium):
        figure = render_training(log, "a run")
        assert find_text_faults(figure) == []


def test_a_style_writes_a_page_s_picture_and_a_paper_s_file(tmp_path: Path) -> None:
    with style("cvpr-column", title=False):
        save_training(make_log(4), "a run", tmp_path / "curves.png")
    save_training(make_log(4), "a run", tmp_path / "plain.png")
    widths = [imread(tmp_path / name).shape[1] for name in ("curves.png", "plain.png")]
    assert widths[0] == widths[1]
    assert b"/MediaBox [ 0 0 234 " in (tmp_path / "curves.pdf").read_bytes()  # 3.25 inches
