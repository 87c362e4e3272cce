"""The worst and the best samples of a run, and the outcomes of cells."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import title_of, tokens_of
from evaluation_runs import META, stored_run
from matplotlib.colors import to_rgb
from picture_texts import text_faults
from report_page import page_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.captions import moment_words, scene_words
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.evaluation.figures import complete_figure, run_figures, sample_figures
from deepaccident_devkit.render.styles import OUTCOME_COLORS

pytestmark = pytest.mark.slow


def test_outcomes_of_cells_are_coloured(da_motion: DeepAccident, tokens: list[str]) -> None:
    label = da_motion.motion_labels(tokens[0], MotionLabelConfig(protocol="clean"))
    truth = label.to_present("bilinear")
    shifted = np.roll(truth.instance, 3, 2)
    for orientation in ("devkit", "released"):
        grid = truth.config.grid.with_orientation(orientation)
        output = instances_of(
            grid.reorient(shifted, "devkit")
            if orientation == "devkit"
            else truth.config.grid.reorient(shifted, orientation),
            grid,
        )
        last = int(truth.label_valid.sum()) - 1
        for frame, drawn in ((None, last), (0, 0)):
            ax = draw_motion_outcome(output, label, frame=frame, ax=detached_figure((4, 4)).add_subplot())
            assert ("now" in ax.get_title()) == (frame == 0)
            picture = np.asarray(ax.images[0].get_array())
            there = truth.config.grid.reorient(shifted[drawn] > 0, "devkit")
            true = truth.config.grid.reorient(truth.segmentation[drawn] == 1, "devkit")
            for kind, cells in (("right", there & true), ("false", there & ~true), ("missed", true & ~there)):
                assert cells.any()
                assert np.array_equal((picture == to_rgb(OUTCOME_COLORS[kind])).all(axis=-1), cells), kind


@pytest.mark.parametrize("task", ["motion", "accident", "detection", "warning"])
def test_samples_of_stored_results_are_ranked_and_drawn(task: Any, da_motion: DeepAccident, tmp_path: Path) -> None:
    protocol = {"accident": "boxes", "warning": "clean"}.get(task, "released")
    run, results = stored_run(da_motion, EvaluationSetup(task=task, protocol=protocol), tmp_path / "results")
    figures = sample_figures(run, da_motion, results)
    if task == "warning":
        assert not figures
        return
    assert [each.name for each in figures] == [f"sample_{kind}_{n}" for kind in ("worst", "best") for n in (1, 2, 3)]
    values = [float(re.findall(r"\d+\.\d+", each.caption.rsplit(",", 1)[1])[-1]) for each in figures]
    assert values[:3] == sorted(values[:3])
    assert values[3:] == sorted(values[3:], reverse=True)
    assert max(values[:3]) <= min(values[3:])
    for each in figures:
        figure = complete_figure(run, each)
        assert text_faults(figure) == []
        [token] = tokens_of(figure)
        assert token in each.caption
        scene = scene_words(da_motion, token.rsplit("/", 2)[0])
        assert title_of(figure.axes[0]).startswith(f"{scene}: {moment_words(da_motion, token)} ")
    if task == "accident":
        page = page_of(save_report(run, tmp_path / "report", dataset=da_motion, results=results))
        assert len(page.all("img")) == len(run_figures(run)) + 6
        assert META["method"] in page.text
