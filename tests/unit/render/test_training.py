"""Curves of a training run: a panel for each number, and a file that is there whole or not at
all.
"""

from pathlib import Path

import numpy as np
import pytest
from picture_texts import text_faults

from deepaccident_devkit.render import detached_figure, style
from deepaccident_devkit.render.training import render_curve, render_training, save_training


def rows(steps: int) -> list[dict]:
    """A log with two losses, and two scores at every fourth step."""
    log = []
    for step in range(1, steps + 1):
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
    assert render_training(rows(8), "a run", fig=figure) is figure
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == ["total", "seg", "flow", "validation: iou", "validation: score", ""]
    dots, line = figure.axes[3].get_lines()
    for each in (dots, line):
        np.testing.assert_allclose(each.get_xydata(), [[4, 0.04], [8, 0.08]])


def test_a_loss_of_nothing_is_a_gap() -> None:
    log = [
        {"step": step, "losses": {"seg": 0.0 if step in (3, 4) else 1.0}} for step in range(1, 7)
    ]
    (ax, *_) = render_training(log, "a run", fig=detached_figure((10, 3))).axes
    for line in ax.get_lines():
        assert np.isnan(line.get_ydata()).tolist() == [False, False, True, True, False, False]


def test_many_steps_are_averaged() -> None:
    """Each dot stays, and the line keeps the mean."""
    values = np.random.default_rng(0).normal(2.0, 1.0, 600)
    ax = render_curve(range(600), values, "loss", ax=detached_figure((3, 2)).subplots())
    _, line = ax.get_lines()
    assert (len(line.get_xydata()), line.get_ydata().mean()) == (60, pytest.approx(values.mean()))
    np.testing.assert_allclose(line.get_xydata()[0], [4.5, values[:10].mean()])


@pytest.mark.parametrize("log", [[], [{"step": 1, "losses": {"seg": 1.0}}], [{"step": 3}]])
def test_short_logs_are_drawn(log: list[dict], tmp_path: Path) -> None:
    with style("ieee-page"):
        save_training(log, "begun", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_words_are_apart_and_large() -> None:
    assert text_faults(render_training(rows(12), "a run")) == []
