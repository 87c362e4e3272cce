"""Reports of runs: all in one file, nothing from outside, partial ones marked everywhere, names harmless."""

import re
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluation_runs import META, PARTIAL, evaluation_run, stored_run
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from PIL import Image

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation import instances_of
from deepaccident_devkit.evaluation.headlines import headlines
from deepaccident_devkit.evaluation.setups import EvaluationSetup
from deepaccident_devkit.motion import MotionLabelConfig, samples
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.colors import OUTCOME_COLORS
from deepaccident_devkit.render.evaluation import draw_motion_outcome, save_report
from deepaccident_devkit.render.evaluation.figures import run_figures
from deepaccident_devkit.render.evaluation.markup import Markup, tag, tree
from deepaccident_devkit.render.evaluation.samples import sample_figures

SETUPS = (
    EvaluationSetup(task="motion"),
    EvaluationSetup(task="accident", protocol="boxes"),
    EvaluationSetup(task="accident", protocol="paper"),
    EvaluationSetup(task="detection"),
    EvaluationSetup(task="warning", protocol="boxes"),
)
EVIL = '</script><script>alert("x")</script><img src=http://x.example/y.png onerror=alert(1)>&'


@pytest.fixture(scope="module")
def tokens(da_motion: DeepAccident) -> list[str]:
    """Of two agents, in an accident and its twin."""
    listed = samples(da_motion, "train", "evaluate", "paper", scope="all")
    return [token for token in listed if token.split("/")[-2] in ("ego_vehicle", "infrastructure")]


class Page(HTMLParser):
    """Elements with their attributes and text; refuses tags that do not match."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in ("img", "meta"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, name: str) -> list[dict[str, str | None]]:
        return [attributes for found, attributes in self.found if found == name]


def page_of(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: f"{setup.task} {setup.protocol}")
def test_a_report_holds_all_and_asks_for_nothing(
    setup: EvaluationSetup, da_motion: DeepAccident, tokens: list[str], tmp_path: Path
) -> None:
    run = evaluation_run(da_motion, setup, tokens)
    page = page_of(save_report(run, tmp_path))
    figures = sorted((tmp_path / "figures").iterdir())
    assert [path.stem for path in figures] == sorted(each.name for each in run_figures(run))
    assert len(page.all("img")) == len(figures) >= 4
    for image in page.all("img"):
        assert str(image["src"]).startswith("data:image/png;base64,")
        assert len(str(image["alt"])) > 10
    assert not [name for name, _ in page.found if name in ("script", "link", "iframe", "object", "form")]
    assert {str(link["href"])[0] for link in page.all("a")} == {"#"}
    assert {str(link["href"])[1:] for link in page.all("a")} == {str(each["id"]) for each in page.all("section")}
    assert "PARTIAL" not in page.text
    assert not any(map(red_pixels, figures))
    for headline in headlines(setup.task, run.result):
        assert headline.name in page.text
        assert headline.text() in page.text
    for told in (run.release.fingerprint, run.results.fingerprint, setup.protocol, "deepaccident evaluate verify"):
        assert told in page.text
    for switch in re.findall(r"'(\w+)':", str(run.setup.as_dict()["settings"])):
        assert switch in page.text


def test_the_same_run_makes_the_same_bytes(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    runs = [evaluation_run(da_motion, SETUPS[2], tokens[::2]) for _ in range(2)]
    path = save_report(runs[0], tmp_path)
    before = {each: each.read_bytes() for each in (path, *(tmp_path / "figures").iterdir())}
    save_report(runs[1], tmp_path)
    assert before == {each: each.read_bytes() for each in (path, *(tmp_path / "figures").iterdir())}
    with pytest.raises(ConfigError, match="is a file; give a folder"):
        save_report(runs[0], path)


def red_pixels(path: Path) -> int:
    with Image.open(path) as picture:
        return int((np.abs(np.asarray(picture.convert("RGB")) - (176, 0, 32)).max(axis=-1) < 8).sum())


def test_a_partial_run_says_so_everywhere(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    page = page_of(save_report(evaluation_run(da_motion, SETUPS[1], tokens, partial=PARTIAL), tmp_path))
    marks = page.text.count("PARTIAL: 120 of 180 samples, 2 predictions left out")
    assert marks == 1 + len(page.all("section"))
    for path in (tmp_path / "figures").iterdir():
        assert red_pixels(path) > 50, path
        with Image.open(path) as picture:
            assert str(picture.info["Description"]).startswith("PARTIAL: 120 of 180 samples")
            assert "protocol boxes, devkit" in str(picture.info["Description"])


def test_names_from_elsewhere_are_harmless(da_motion: DeepAccident, tokens: list[str], tmp_path: Path) -> None:
    meta: Mapping[str, Any] = {"method": EVIL, EVIL: [{EVIL: EVIL}]}
    sanity = {
        "samples": 20,
        "perfect": {"apa": 1.0},
        "empty": {"apa": 0.0},
        "given": {"apa": None},
        "units": {"apa": "share"},
        "candidates": [{"name": EVIL, "description": EVIL, "score": 0.5, "given": None, "suspected": True}],
        "warnings": [EVIL],
    }
    explanation = {
        "samples": 6,
        "protocol": EVIL,
        "units": {"apa": "share"},
        "chosen": {"apa": 0.5},
        "protocols": {EVIL: {"apa": 0.5}, "paper": {}},
        "numbers": [
            {"choice": EVIL, "headline": "apa", "value": 0.75, "change": 0.25, "changed": True},
            {"choice": "idle=no", "headline": "apa", "value": 0.5, "change": 0.0, "changed": False},
        ],
        "refused": {EVIL: EVIL},
    }
    run = evaluation_run(da_motion, SETUPS[1], tokens, meta=meta, sanity=sanity, explanation=explanation)
    path = save_report(run, tmp_path)
    page = page_of(path)
    assert not page.all("script")
    assert all(str(image["src"]).startswith("data:") for image in page.all("img"))
    assert page.text.count(EVIL) >= 11
    assert "+0.250" in page.text
    assert "No number changes with: idle=no." in page.text
    assert "http" not in re.sub(r"http-equiv", "", path.read_text().replace("http://x.example/y.png", ""))


@given(
    st.recursive(
        st.text() | st.floats() | st.none() | st.booleans(),
        lambda each: st.lists(each) | st.dictionaries(st.text(), each),
    )
)
def test_any_value_becomes_well_formed_html(value: Any) -> None:
    Page(tree(value))
    Page(tag("p", str(value), title=str(value)))


def test_only_markup_is_not_escaped() -> None:
    assert tag("p", "<b>", Markup("<i>x</i>"), class_='"') == '<p class="&quot;">&lt;b&gt;<i>x</i></p>'
    assert tree({"a": [1.0, None, True]}) == (
        '<table class="tree"><tr><th scope="row">a</th><td>1, –, yes</td></tr></table>'
    )
    assert "0.333333</td>" in tree([{"name": "a", "share": 1 / 3}, {"other": 2}])


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
        ax = draw_motion_outcome(output, label, ax=detached_figure((4, 4)).add_subplot())
        picture = np.asarray(ax.images[0].get_array())
        frame = int(truth.label_valid.sum()) - 1
        there = truth.config.grid.reorient(shifted[frame] > 0, "devkit")
        true = truth.config.grid.reorient(truth.segmentation[frame] == 1, "devkit")
        for kind, cells in (("right", there & true), ("false", there & ~true), ("missed", true & ~there)):
            assert cells.any()
            assert np.array_equal((picture == to_rgb(OUTCOME_COLORS[kind])).all(axis=-1), cells), kind


@pytest.mark.parametrize("task", ["motion", "accident", "detection", "warning"])
def test_samples_of_stored_results_are_ranked_and_drawn(task: Any, da_motion: DeepAccident, tmp_path: Path) -> None:
    protocol = "released" if task in ("motion", "detection") else "boxes"
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
        assert each.draw(ax=detached_figure((5, 4)).add_subplot()).get_title()
    if task == "accident":
        page = page_of(save_report(run, tmp_path / "report", dataset=da_motion, results=results))
        assert len(page.all("img")) == len(run_figures(run)) + 6
        assert META["method"] in page.text
