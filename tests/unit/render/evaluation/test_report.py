"""Reports of runs: all in one file, nothing from outside, partial ones marked everywhere, names harmless."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawing import title_of, tokens_of
from evaluation_runs import META, PARTIAL, evaluation_run, stored_run
from matplotlib.colors import to_rgb
from picture_texts import text_faults
from PIL import Image
from report_page import page_of

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.captions import moment_words, scene_words
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.evaluation.figures import complete_figure, run_figures, sample_figures
from deepaccident_devkit.render.styles import OUTCOME_COLORS, WARNING_COLOR

pytestmark = pytest.mark.slow


SETUPS = (
    EvaluationSetup(task="motion"),
    EvaluationSetup(task="accident", protocol="boxes"),
    EvaluationSetup(task="accident", protocol="paper"),
    EvaluationSetup(task="detection"),
    EvaluationSetup(task="warning", protocol="clean"),
    EvaluationSetup(task="warning", protocol="clean"),
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
    assert len(page.all("img")) == len(figures) >= (1 if setup.protocol == "clean" else 4)
    for image in page.all("img"):
        assert str(image["src"]).startswith("data:image/png;base64,")
        assert len(str(image["alt"])) > 10
    assert not [name for name, _ in page.found if name in ("script", "link", "iframe", "object", "form")]
    assert {str(link["href"])[0] for link in page.all("a")} == {"#"}
    assert {str(link["href"])[1:] for link in page.all("a")} == {str(each["id"]) for each in page.all("section")}
    assert "PARTIAL" not in page.text
    assert not any(map(warning_pixels, figures))
    for headline in headlines(setup.task, run.result):
        assert headline.name in page.text
        assert headline.text() in page.text
    assert ("TTC < 3 s, seen" in page.text) == (setup.protocol == "clean")
    assert "no intervals: of 1 cluster (an accident and its twin are one); at least 6 are needed" in page.text
    for told in (run.release.fingerprint, run.results.fingerprint, setup.protocol, "deepaccident evaluate verify"):
        assert told in page.text
    for switch in re.findall(r"'(\w+)':", str(run.setup.as_dict()["settings"])):
        assert switch in page.text


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
def test_words_of_figures_are_apart(setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str]) -> None:
    for partial in (None, PARTIAL):
        run = evaluation_run(da_motion, setup, tokens, partial=partial)
        for each in run_figures(run):
            figure = complete_figure(run, each)
            assert text_faults(figure) == [], each.name
            drawn = figure.get_tightbbox()
            assert min(*drawn.min, *(figure.get_size_inches() - drawn.max)) > -0.01, each.name


def test_a_class_without_true_boxes_has_a_dash(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    run = evaluation_run(da_motion, SETUPS[3], tokens)
    result = run.result
    truths = result.truths * (np.array(result.classes) != "car")[:, None]
    page = page_of(save_report(replace(run, result=replace(result, truths=truths)), tmp_path))
    there = f"{result.class_average_precision['car']:.2f} %"
    assert f"AP car{there}" in page_of(save_report(run, tmp_path)).text
    assert "AP car–" in page.text
    assert f"AP car{there}" not in page.text


def test_intervals_stand_beside_their_numbers(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    run = evaluation_run(da_motion, SETUPS[1], tokens)
    everything, *others = run.breakdowns
    group = replace(everything.groups[0], intervals={"apa": (0.6123, 0.9)}, notes=())
    run = replace(run, breakdowns=(replace(everything, groups=(group,)), *others))
    page = page_of(save_report(run, tmp_path))
    assert "0.612 to 0.900" in page.text
    assert "no intervals" not in page.text


def test_the_same_run_makes_the_same_bytes(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    runs = [evaluation_run(da_motion, SETUPS[2], tokens[::2]) for _ in range(2)]
    path = save_report(runs[0], tmp_path)
    before = {each: each.read_bytes() for each in (path, *(tmp_path / "figures").iterdir())}
    save_report(runs[1], tmp_path)
    assert before == {each: each.read_bytes() for each in (path, *(tmp_path / "figures").iterdir())}
    with pytest.raises(ConfigError, match="is a file; give a folder"):
        save_report(runs[0], path)
    (tmp_path / "planted").mkdir()
    (tmp_path / "planted" / "figures").symlink_to(tmp_path / "figures")
    with pytest.raises(OutputFolderError, match="figures: a symbolic link, which no devkit makes; remove it"):
        save_report(runs[0], tmp_path / "planted")


def test_a_partial_run_says_so_everywhere(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    page = page_of(save_report(evaluation_run(da_motion, SETUPS[1], tokens, partial=PARTIAL), tmp_path))
    marks = page.text.count("PARTIAL: 120 of 180 samples, 2 predictions left out")
    assert marks == 1 + len(page.all("section"))
    for path in (tmp_path / "figures").iterdir():
        assert warning_pixels(path) > 50, path
        with Image.open(path) as picture:
            assert str(picture.info["Description"]).startswith("PARTIAL: 120 of 180 samples")
            assert "protocol boxes, devkit" in str(picture.info["Description"])


def test_names_from_elsewhere_are_harmless(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    meta: Mapping[str, Any] = {"method": EVIL, EVIL: [{EVIL: EVIL}]}
    run = evaluation_run(da_motion, SETUPS[1], tokens, meta=meta, sanity={"samples": 20, "warnings": [EVIL]})
    path = save_report(run, tmp_path)
    page = page_of(path)
    assert not page.all("script")
    assert all(str(image["src"]).startswith("data:") for image in page.all("img"))
    assert page.text.count(EVIL) >= 3
    assert "http" not in re.sub(
        r"http-equiv", "", path.read_text().replace("<wbr>", "").replace("http://x.example/y.png", "")
    )


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
