"""Reports of runs: all in one file, nothing from outside, partial ones marked everywhere, names
harmless.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import new_axes, picture, tokens_of
from evaluation_runs import META, PARTIAL, evaluation_run, stored_run
from matplotlib.colors import to_rgb, to_rgba
from picture_texts import text_faults
from PIL import Image
from refusals import assert_refused
from report_page import page_of
from wording import holding, lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.evaluation.figures import (
    complete_figure,
    run_figures,
    sample_figures,
)
from deepaccident_devkit.render.styles import OUTCOME_COLORS, WARNING_COLOR

pytestmark = pytest.mark.slow


SETUPS = (
    EvaluationSetup(task="motion"),
    EvaluationSetup(task="accident", protocol="boxes"),
    EvaluationSetup(task="accident", protocol="paper"),
    EvaluationSetup(task="detection"),
    EvaluationSetup(task="warning", protocol="clean"),
    EvaluationSetup(task="planning", protocol="vad"),
    EvaluationSetup(task="forecasting", protocol="clean"),
)


def warning_pixels(path: Path) -> int:
    with Image.open(path) as picture:
        warning = 255 * np.array(to_rgb(WARNING_COLOR))
        return int((np.abs(np.asarray(picture.convert("RGB")) - warning).max(axis=-1) < 8).sum())


EVIL = '</script><script>alert("x")</script><img src=http://x.example/y.png onerror=alert(1)>&'


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
def test_a_report_holds_all_and_asks_for_nothing(
    setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    run = evaluation_run(da_motion, setup, tokens)
    page = page_of(save_report(run, tmp_path))
    figures = sorted((tmp_path / "figures").iterdir())
    assert [path.stem for path in figures] == sorted(each.name for each in run_figures(run))
    assert (
        len(page.all("img"))
        == len(figures)
        >= (1 if TASKS[setup.task].needs_whole_recordings else 4)
    )
    assert {str(image["src"])[:22] for image in page.all("img")} == {"data:image/png;base64,"}
    assert not holding(
        [name for name, _ in page.found], "script", "link", "iframe", "object", "form"
    )
    assert {str(link["href"]) for link in page.all("a")} == {
        f"#{each['id']}" for each in page.all("section")
    }
    assert sum(map(warning_pixels, figures)) == 0
    numbers = [words for each in headlines(run.result) for words in (each.name, each.text())]
    told = (
        run.release.fingerprint,
        run.results.fingerprint,
        setup.protocol,
        "deepaccident check bundle",
    )
    assert not lacking(page.text, *told, *numbers)
    assert "PARTIAL" not in page.text


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
def test_words_of_figures_are_apart(
    setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str]
) -> None:
    run = evaluation_run(da_motion, setup, tokens, partial=PARTIAL)
    assert {each.name: text_faults(complete_figure(run, each)) for each in run_figures(run)} == {
        each.name: [] for each in run_figures(run)
    }


def test_the_same_run_makes_the_same_bytes(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    made = []
    for name in ("a", "b"):
        run, folder = evaluation_run(da_motion, SETUPS[2], tokens[::2]), tmp_path / name
        path = save_report(run, folder)
        made.append(
            {each.name: each.read_bytes() for each in (path, *(folder / "figures").iterdir())}
        )
    assert made[0] == made[1]
    (tmp_path / "planted").mkdir()
    (tmp_path / "planted" / "figures").symlink_to(tmp_path / "a" / "figures")
    assert_refused(
        (lambda: save_report(run, path), ConfigError, ("is a file", "give a folder")),
        (
            lambda: save_report(run, tmp_path / "planted"),
            OutputFolderError,
            ("figures: a symbolic link", "remove it"),
        ),
    )


def test_a_partial_run_says_so_everywhere(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    page = page_of(
        save_report(evaluation_run(da_motion, SETUPS[1], tokens, partial=PARTIAL), tmp_path)
    )
    marks = page.text.count("PARTIAL: 120 of 180 samples, 2 predictions left out")
    assert marks == 1 + len(page.all("section"))
    for path in (tmp_path / "figures").iterdir():
        assert warning_pixels(path) > 50, path
        with Image.open(path) as picture:
            described = str(picture.info["Description"])
        assert described.startswith("PARTIAL: 120 of 180 samples")


def test_names_from_elsewhere_are_harmless(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    meta: Mapping[str, Any] = {"method": EVIL, EVIL: [{EVIL: EVIL}]}
    run = evaluation_run(
        da_motion, SETUPS[1], tokens, meta=meta, sanity={"samples": 20, "warnings": [EVIL]}
    )
    path = save_report(run, tmp_path)
    page, text = (
        page_of(path),
        path.read_text().replace("<wbr>", "").replace("http://x.example/y.png", ""),
    )
    assert (page.all("script"), {str(image["src"])[:5] for image in page.all("img")}) == (
        [],
        {"data:"},
    )
    assert "http" not in text.replace("http-equiv", "")


def test_outcomes_of_cells_are_coloured(da_motion: DeepAccident, tokens: list[str]) -> None:
    label = da_motion.motion_labels(tokens[0], MotionLabelConfig(protocol="clean"))
    truth, last = label.to_present("bilinear"), int(label.label_valid.sum()) - 1
    own, shifted = truth.config.grid, np.roll(truth.instance, 3, 2)
    for frame, drawn in ((None, last), (0, 0)):
        ax = draw_motion_outcome(instances_of(shifted, own), label, frame=frame, ax=new_axes())
        there, true = (
            own.reorient(each[drawn] > 0, "devkit") for each in (shifted, truth.segmentation == 1)
        )
        for kind, cells in (
            ("right", there & true),
            ("false", there & ~true),
            ("missed", true & ~there),
        ):
            assert cells.any()
            assert np.array_equal(
                (picture(ax) == to_rgba(OUTCOME_COLORS[kind])).all(axis=-1), cells
            ), kind


@pytest.mark.parametrize("task", ["motion", "accident", "detection", "warning"])
def test_samples_of_stored_results_are_ranked_and_drawn(
    task: Any, da_motion: DeepAccident, tmp_path: Path
) -> None:
    protocol = {"accident": "boxes", "warning": "clean"}.get(task, "released")
    run, results = stored_run(
        da_motion, EvaluationSetup(task=task, protocol=protocol), tmp_path / "results"
    )
    figures = sample_figures(run, da_motion, results)
    ranked = [f"sample_{kind}_{number}" for kind in ("worst", "best") for number in (1, 2, 3)]
    assert [each.name for each in figures] == ([] if protocol == "clean" else ranked)
    values = [
        float(re.findall(r"\d+\.\d+", each.caption.rsplit(",", 1)[1])[-1]) for each in figures
    ]
    assert values == sorted(values[:3]) + sorted(values[3:], reverse=True)
    assert max(values[:3], default=0) <= min(values[3:], default=0)
    for each in figures:
        figure = complete_figure(run, each)
        (token,) = tokens_of(figure)
        assert (text_faults(figure), token in each.caption) == ([], True)
    if task == "accident":
        page = page_of(save_report(run, tmp_path / "report", dataset=da_motion, results=results))
        assert (len(page.all("img")), META["method"] in page.text) == (
            len(run_figures(run)) + 6,
            True,
        )
