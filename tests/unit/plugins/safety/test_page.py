"""The page of the safety report: a row an accident, the functions' numbers, harmless names, links
to files.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest
from refusals import assert_refused
from report_page import Page, page_of
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.collisions import Skipped
from deepaccident_devkit.descriptions import Story
from deepaccident_devkit.errors import ChoiceError, ConfigError, OutputFolderError
from deepaccident_devkit.plugins.safety import SafetyReport, safety_report
from deepaccident_devkit.plugins.safety import page as report_module
from deepaccident_devkit.plugins.safety.page import (
    replay_names,
    safety_report_html,
    save_safety_report,
)
from deepaccident_devkit.support.pages import source_hash

HOSTILE = (
    "type1_subtype1_accident/<script>alert(1)</script><img "
    "src=\"https://evil.example/x\" onerror='x'>"
)


@pytest.fixture(scope="module")
def report(da_motion: DeepAccident) -> SafetyReport:
    return safety_report(da_motion, workers=1)


@pytest.fixture(scope="module")
def folder(
    da_motion: DeepAccident, report: SafetyReport, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    out = tmp_path_factory.mktemp("report") / "of a release"
    written = save_safety_report(report, out, dataset=da_motion, workers=1)
    assert sorted(written) == sorted(path for path in out.rglob("*") if path.is_file())
    assert written[-1] == out / "report.html"
    return out


@pytest.fixture
def _without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take most of the time, and other tests look at them."""
    monkeypatch.setattr(report_module, "figures_of", lambda _: iter(()))


def cells(page: str) -> list[list[str]]:
    """The texts of the cells of each row of the table of accidents."""
    (body,) = re.findall(r'<table class="sortable">.*?<tbody>(.*?)</tbody>', page, re.DOTALL)
    rows = re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL)
    return [
        [Page(cell).text for cell in re.findall(r"<t[hd][ >].*?</t[hd]>", row, re.DOTALL)]
        for row in rows
    ]


def renamed(report: SafetyReport, name: str, **facts: object) -> SafetyReport:
    """The report with one accident of another name."""
    (row,) = report.rows
    story = Story(facts={**row.story.facts, "scenario": name, **facts}, text=row.story.text)
    return replace(report, rows=(replace(row, story=story),))


def addresses(page: Page) -> list[str]:
    """Those of links to other files."""
    return [each for link in page.all("a") if not (each := str(link["href"])).startswith("#")]


def test_a_row_has_the_numbers(report: SafetyReport, folder: Path) -> None:
    (line,) = cells((folder / "report.html").read_text(encoding="utf-8"))
    (row,) = report.rows
    assert [each["agent"] for each in row.colliders] == ["other_vehicle", "ego_vehicle"]
    speeds, changes = (
        " / ".join(f"{each[name]:.1f}" for each in row.colliders) for name in ("speed", "delta_v")
    )
    closing = f"{row.story.facts['accident']['closing_speed']:.1f}"
    assert line == [
        *(
            f"{row.scenario}replay",
            row.story.text,
            "other (car), ego (car)",
            speeds,
            changes,
            closing,
        ),
        *(f"{lead:.1f}" if lead else "never" for lead in row.leads.values()),
        *("ego", *(f"{row.last_moments[each]:.2f}" for each in (4, 6, 8))),
        *(f"{row.to_dict()['time_exposed']:.1f}", f"{row.parts:.1f}"),
    ]


def test_the_whole_page(report: SafetyReport, folder: Path) -> None:
    page = page_of(folder / "report.html")
    # one group of accidents, and lead times
    assert [str(each["src"])[:22] for each in page.all("img")] == ["data:image/png;base64,"] * 2
    (replay,) = addresses(page)
    assert (folder / unquote(replay)).is_file()
    assert not lacking(
        page.text, f"{report.ledger.mean_together.text} s", report.normal[0].facts["scenario"]
    )
    assert json.loads((folder / "safety.json").read_text())["scenarios"] == 2


def test_only_its_own_script_runs(folder: Path) -> None:
    page = page_of(folder / "report.html")
    (script,) = re.findall(
        r"<script>(.*?)</script>", (folder / "report.html").read_text(encoding="utf-8"), re.DOTALL
    )
    (policy,) = [str(each["content"]) for each in page.all("meta") if "http-equiv" in each]
    assert policy.startswith("default-src 'none'")
    assert policy.endswith(f"script-src '{source_hash(script)}'")


def test_names_are_harmless(report: SafetyReport) -> None:
    broken = replace(renamed(report, HOSTILE), broken=(Skipped(scenario=HOSTILE, reason=HOSTILE),))
    page = Page(safety_report_html(broken, [], replay_names([HOSTILE]), [(HOSTILE, HOSTILE)]))
    assert (len(page.all("script")), page.all("img")) == (1, [])
    assert page.text.count("<script>alert(1)</script>") == 5
    (link,) = addresses(page)
    assert re.fullmatch(r"replays/[\w.-]+\.html", link)


def test_replay_pages_have_names_of_their_own() -> None:
    names = replay_names(["a/b", "a_b", "a?b", "x" * 300, f"{'x' * 300}y", "../../up"])
    wrong = [
        name
        for name in names.values()
        if not re.fullmatch(r"replays/[A-Za-z0-9_.-]{1,140}\.html", name)
    ]
    assert (len(set(names.values())), wrong, names["../../up"]) == (6, [], "replays/.._.._up.html")


@pytest.mark.usefixtures("_without_figures")
def test_the_hardest_have_replay_pages(
    report: SafetyReport, da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mild, hard = "type1_subtype1_accident/mild", "type1_subtype1_accident/hard"
    accident = report.rows[0].story.facts["accident"]
    worse = accident | {"pair": [{**each, "delta_v": 99.0} for each in accident["pair"]]}
    several = replace(
        report, rows=(*renamed(report, mild).rows, *renamed(report, hard, accident=worse).rows)
    )
    made: list[str] = []
    monkeypatch.setattr(
        report_module, "tried_replay", lambda _dataset, scenario, _path: made.append(scenario)
    )
    for count, expected in ((0, []), (1, [hard]), (2, [hard, mild]), (None, [hard, mild])):
        made.clear()
        save_safety_report(several, tmp_path, dataset=da_motion, replays=count, workers=1)
        assert made == expected


def test_a_release_without_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    report = safety_report(da_motion, da_motion.find(collision=False), workers=1)
    page = page_of(save_safety_report(report, tmp_path, dataset=da_motion, workers=1)[-1])
    assert ("No accident can be replayed." in page.text, page.all("img")) == (True, [])


@pytest.mark.usefixtures("_without_figures")
def test_a_second_report_replaces_the_first(
    report: SafetyReport, folder: Path, tmp_path: Path
) -> None:
    contents = [path.read_bytes() for path in save_safety_report(report, tmp_path)]
    (tmp_path / "mine.txt").write_text("stays")
    assert [path.read_bytes() for path in save_safety_report(report, tmp_path)] == contents
    assert ((tmp_path / "mine.txt").is_file(), (tmp_path / "replays").exists()) == (True, False)
    assert_refused(
        (
            lambda: save_safety_report(report, folder / "report.html"),
            ConfigError,
            ("is a file", "give a folder"),
        ),
        (
            lambda: save_safety_report(report, tmp_path, replays=-1),
            ChoiceError,
            ("replays", "None for all", "-1"),
        ),
    )


@pytest.mark.parametrize("name", ["figures", "replays"])
@pytest.mark.usefixtures("_without_figures")
def test_nothing_is_written_through_a_link(
    report: SafetyReport, da_motion: DeepAccident, tmp_path: Path, name: str
) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    for folder in (outside, out):
        folder.mkdir()
    (out / name).symlink_to(outside)
    told = f"{name}: a symbolic link", "remove it"
    assert_refused(
        (
            lambda: save_safety_report(report, out, dataset=da_motion, workers=1),
            OutputFolderError,
            told,
        )
    )
    assert not list(outside.iterdir())
