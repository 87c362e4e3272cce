"""Reports of runs are one file each, load nothing from outside, mark partial runs everywhere and
make names harmless.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb, to_rgba
from PIL import Image
from support.evaluation_runs import META, PARTIAL, evaluation_run, stored_run
from support.expected_errors import assert_raises
from support.figure_texts import find_text_faults
from support.rendered_pixels import first_image, new_axes, read_tokens
from support.report_page import read_report
from support.text_contents import contained_parts, missing_parts

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError, OutputFolderError
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.runs.setups import TASKS, EvaluationSetup
from deepaccident_devkit.evaluation.task import headlines
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.render import style
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.evaluation.figures import (
    complete_figure,
    run_figures,
    sample_figures,
)
from deepaccident_devkit.render.styles import OUTCOME_COLORS, WARNING_COLOR
from deepaccident_devkit.support.human_names import metric_name
from deepaccident_devkit.support.text import with_minus

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


def count_warning_pixels(path: Path) -> int:
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    color_distance = np.abs(pixels - 255 * np.array(to_rgb(WARNING_COLOR))).max(axis=-1)
    return int((color_distance < 8).sum())


MALICIOUS_TEXT = (
    '</script><script>alert("x")</script><img src=http://x.example/y.png onerror=alert(1)>&'
)


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
def test_a_report_contains_everything_and_requests_nothing(
    setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    run = evaluation_run(da_motion, setup, tokens)
    page = read_report(save_report(run, tmp_path))

    figures = sorted((tmp_path / "figures").iterdir())
    assert [path.stem for path in figures] == sorted(figure.name for figure in run_figures(run))
    min_figures = 1 if TASKS[setup.task].needs_whole_recordings else 4
    assert len(page.all("img")) == len(figures) >= min_figures
    assert {str(image["src"])[:22] for image in page.all("img")} == {"data:image/png;base64,"}

    tags = [tag for tag, _ in page.elements]
    assert not contained_parts(tags, "script", "link", "iframe", "object", "form")
    link_targets = {str(link["href"]) for link in page.all("a")}
    assert link_targets == {f"#{section['id']}" for section in page.all("section")}
    assert sum(map(count_warning_pixels, figures)) == 0

    numbers = []
    for headline in headlines(run.result):
        numbers += [metric_name(headline.name), with_minus(headline.text())]
    assert not missing_parts(
        page.text,
        run.release.fingerprint,
        run.results.fingerprint,
        setup.protocol,
        "deepaccident check bundle",
        *numbers,
    )
    assert "PARTIAL" not in page.text


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
@pytest.mark.parametrize("medium", [None, pytest.param("cvpr-column", marks=pytest.mark.slow)])
def test_words_of_figures_are_apart(
    medium: Any, setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str]
) -> None:
    run = evaluation_run(da_motion, setup, tokens, partial=PARTIAL)
    with style(medium):
        for figure in run_figures(run):
            assert find_text_faults(complete_figure(run, figure)) == [], figure.name


def test_figures_without_titles_still_mark_a_partial_run(
    da_motion: DeepAccident, tokens: list[str]
) -> None:
    run = evaluation_run(da_motion, SETUPS[0], tokens, partial=PARTIAL)
    run_figure = run_figures(run)[0]
    with style(title=False):
        figure = complete_figure(run, run_figure)
    assert [ax.get_title() for ax in figure.axes] == [""]
    assert "PARTIAL" in figure.get_suptitle()


def test_the_same_run_makes_the_same_bytes(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    contents = []
    for name in ("a", "b"):
        folder = tmp_path / name
        run = evaluation_run(da_motion, SETUPS[2], tokens[::2])
        path = save_report(run, folder)
        files = (path, *(folder / "figures").iterdir())
        contents.append({file.name: file.read_bytes() for file in files})
    assert contents[0] == contents[1]

    planted = tmp_path / "planted"
    planted.mkdir()
    (planted / "figures").symlink_to(tmp_path / "a" / "figures")
    assert_raises(
        (lambda: save_report(run, path), ConfigError, ("is a file", "give a folder")),
        (
            lambda: save_report(run, planted),
            OutputFolderError,
            ("figures: is a symbolic link", "remove it"),
        ),
    )


def test_a_partial_run_says_so_everywhere(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    run = evaluation_run(da_motion, SETUPS[1], tokens, partial=PARTIAL)
    page = read_report(save_report(run, tmp_path))
    num_marks = page.text.count("PARTIAL: 120 of 180 samples, 2 predictions left out")

    assert num_marks == 1 + len(page.all("section"))
    for path in (tmp_path / "figures").iterdir():
        assert count_warning_pixels(path) > 50, path
        with Image.open(path) as image:
            description = str(image.info["Description"])
        assert description.startswith("PARTIAL: 120 of 180 samples")


def test_names_from_elsewhere_are_harmless(
    da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    meta: Mapping[str, Any] = {
        "method": MALICIOUS_TEXT,
        MALICIOUS_TEXT: [{MALICIOUS_TEXT: MALICIOUS_TEXT}],
    }
    sanity = {"samples": 20, "warnings": [MALICIOUS_TEXT]}
    run = evaluation_run(da_motion, SETUPS[1], tokens, meta=meta, sanity=sanity)
    path = save_report(run, tmp_path)

    page = read_report(path)
    assert page.all("script") == []
    assert {str(image["src"])[:5] for image in page.all("img")} == {"data:"}
    html = path.read_text().replace("<wbr>", "").replace("http://x.example/y.png", "")
    assert "http" not in html.replace("http-equiv", "")


def test_outcomes_of_cells_are_coloured(da_motion: DeepAccident, tokens: list[str]) -> None:
    label = da_motion.motion_labels(tokens[0], MotionLabelConfig(protocol="clean"))
    truth = label.to_present("bilinear")
    grid = truth.config.grid
    shifted = np.roll(truth.instance, 3, 2)
    last_frame = int(label.label_valid.sum()) - 1
    for frame, drawn_frame in ((None, last_frame), (0, 0)):
        ax = draw_motion_outcome(instances_of(shifted, grid), label, frame=frame, ax=new_axes())

        is_predicted = grid.reorient(shifted[drawn_frame] > 0, "devkit")
        is_true = grid.reorient(truth.segmentation[drawn_frame] == 1, "devkit")
        for outcome, cells in (
            ("right", is_predicted & is_true),
            ("false", is_predicted & ~is_true),
            ("missed", is_true & ~is_predicted),
        ):
            assert cells.any()
            has_outcome_color = (first_image(ax) == to_rgba(OUTCOME_COLORS[outcome])).all(axis=-1)
            assert np.array_equal(has_outcome_color, cells), outcome


@pytest.mark.parametrize("task", ["motion", "accident", "detection", "warning"])
def test_samples_of_stored_results_are_ranked_and_drawn(
    task: Any, da_motion: DeepAccident, tmp_path: Path
) -> None:
    protocol = {"accident": "boxes", "warning": "clean"}.get(task, "released")
    setup = EvaluationSetup(task=task, protocol=protocol)
    run, results = stored_run(da_motion, setup, tmp_path / "results")

    figures = sample_figures(run, da_motion, results)

    names = [f"sample_{kind}_{number}" for kind in ("worst", "best") for number in (1, 2, 3)]
    assert [figure.name for figure in figures] == ([] if protocol == "clean" else names)
    values = []
    for sample_figure in figures:
        score_text = sample_figure.caption.rsplit(",", 1)[1]
        values.append(float(re.findall(r"\d+\.\d+", score_text)[-1]))
        figure = complete_figure(run, sample_figure)
        (token,) = read_tokens(figure)
        assert find_text_faults(figure) == []
        assert token in sample_figure.caption
    worst, best = values[:3], values[3:]
    assert values == sorted(worst) + sorted(best, reverse=True)
    assert max(worst, default=0) <= min(best, default=0)

    if task == "accident":
        path = save_report(run, tmp_path / "report", dataset=da_motion, results=results)
        page = read_report(path)
        assert len(page.all("img")) == len(run_figures(run)) + 6
        assert META["method"] in page.text
