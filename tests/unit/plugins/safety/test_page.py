"""The page of the safety report: a row for each accident, the numbers of the functions, harmless
names, links to files.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import pytest
from support.expected_errors import assert_raises
from support.report_page import ReportPage, read_report
from support.text_contents import missing_parts

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
    """Figures take most of the time, and other tests look at them."""
    monkeypatch.setattr(report_module, "figures_of", lambda _: iter(()))


def read_cells(page: str) -> list[list[str]]:
    """Read the texts of the cells in each row of the table of accidents."""
    (body,) = re.findall(r'<table class="sortable">.*?<tbody>(.*?)</tbody>', page, re.DOTALL)
    rows = []
    for row in re.findall(r"<tr>(.*?)</tr>", body, re.DOTALL):
        cells = re.findall(r"<t[hd][ >].*?</t[hd]>", row, re.DOTALL)
        rows.append([ReportPage(cell).text for cell in cells])

    return rows


def rename_accident(report: SafetyReport, name: str, **facts: object) -> SafetyReport:
    """Return the report with another name, and other facts, for its only accident."""
    (row,) = report.rows
    facts = {**row.story.facts, "scenario": name, **facts}
    return replace(report, rows=(replace(row, story=Story(facts=facts, text=row.story.text)),))


def file_links(page: ReportPage) -> list[str]:
    """List the addresses of links to other files."""
    addresses = [str(link["href"]) for link in page.all("a")]
    return [address for address in addresses if not address.startswith("#")]


def test_a_row_has_the_numbers(report: SafetyReport, folder: Path) -> None:
    (cells,) = read_cells((folder / "report.html").read_text(encoding="utf-8"))
    (row,) = report.rows
    first, second = row.colliders
    assert [first["agent"], second["agent"]] == ["other_vehicle", "ego_vehicle"]

    leads = [f"{lead:.1f}" if lead else "never" for lead in row.leads.values()]
    assert cells == [
        f"{row.scenario}replay",
        "other (car), ego (car)",
        f"{first['speed']:.1f} / {second['speed']:.1f}",
        f"{first['delta_v']:.1f} / {second['delta_v']:.1f}",
        f"{row.story.facts['accident']['closing_speed']:.1f}",
        *leads,
        "ego",
        *(f"{row.last_moments[deceleration]:.2f}" for deceleration in (4, 6, 8)),
        f"{row.to_dict()['time_exposed']:.1f}",
        f"{row.parts:.1f}",
        row.story.text,
    ]


def test_the_whole_page(report: SafetyReport, folder: Path) -> None:
    page = read_report(folder / "report.html")
    # one group of accidents, and lead times
    sources = [str(image["src"]) for image in page.all("img")]
    assert [source[:22] for source in sources] == ["data:image/png;base64,"] * 2

    (replay,) = file_links(page)
    assert (folder / unquote(replay)).is_file()
    message = f"all agents together see them {report.ledger.mean_together.mean:.1f} s before it."
    assert message in page.text
    assert not missing_parts(
        page.text, f"{report.ledger.mean_together.text} s", report.normal[0].facts["scenario"]
    )
    assert json.loads((folder / "safety.json").read_text())["scenarios"] == 2


def test_only_its_own_script_runs(folder: Path) -> None:
    path = folder / "report.html"
    (script,) = re.findall(r"<script>(.*?)</script>", path.read_text(encoding="utf-8"), re.DOTALL)
    (policy,) = [
        str(meta["content"]) for meta in read_report(path).all("meta") if "http-equiv" in meta
    ]

    assert policy.startswith("default-src 'none'")
    assert policy.endswith(f"script-src '{source_hash(script)}'")


def test_names_are_harmless(report: SafetyReport) -> None:
    hostile = replace(
        rename_accident(report, HOSTILE),
        broken=(Skipped(scenario=HOSTILE, reason=HOSTILE),),
    )
    page = ReportPage(
        safety_report_html(hostile, [], replay_names([HOSTILE]), [(HOSTILE, HOSTILE)])
    )
    assert (len(page.all("script")), page.all("img")) == (1, [])
    assert page.text.count("<script>alert(1)</script>") == 5
    (link,) = file_links(page)
    assert re.fullmatch(r"replays/[\w.-]+\.html", link)


def test_replay_pages_have_names_of_their_own() -> None:
    names = replay_names(["a/b", "a_b", "a?b", "x" * 300, f"{'x' * 300}y", "../../up"])
    assert len(set(names.values())) == 6
    assert names["../../up"] == "replays/.._.._up.html"

    for name in names.values():
        assert re.fullmatch(r"replays/[A-Za-z0-9_.-]{1,140}\.html", name)


@pytest.mark.usefixtures("_without_figures")
def test_the_hardest_have_replay_pages(
    report: SafetyReport, da_motion: DeepAccident, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    mild, hard = "type1_subtype1_accident/mild", "type1_subtype1_accident/hard"
    accident = report.rows[0].story.facts["accident"]
    harder_pair = [{**collider, "delta_v": 99.0} for collider in accident["pair"]]
    (mild_row,) = rename_accident(report, mild).rows
    (hard_row,) = rename_accident(report, hard, accident=accident | {"pair": harder_pair}).rows
    both = replace(report, rows=(mild_row, hard_row))

    replayed: list[str] = []
    monkeypatch.setattr(
        report_module, "tried_replay", lambda _dataset, scenario, _path: replayed.append(scenario)
    )
    for count, expected in ((0, []), (1, [hard]), (2, [hard, mild]), (None, [hard, mild])):
        replayed.clear()
        save_safety_report(both, tmp_path, dataset=da_motion, replays=count, workers=1)
        assert replayed == expected


def test_a_release_without_accidents(da_motion: DeepAccident, tmp_path: Path) -> None:
    report = safety_report(da_motion, da_motion.find(collision=False), workers=1)
    page = read_report(save_safety_report(report, tmp_path, dataset=da_motion, workers=1)[-1])
    assert "No accident can be replayed." in page.text
    assert page.all("img") == []


@pytest.mark.usefixtures("_without_figures")
def test_a_second_report_replaces_the_first(
    report: SafetyReport, folder: Path, tmp_path: Path
) -> None:
    contents = [path.read_bytes() for path in save_safety_report(report, tmp_path)]
    (tmp_path / "mine.txt").write_text("stays")
    assert [path.read_bytes() for path in save_safety_report(report, tmp_path)] == contents
    assert (tmp_path / "mine.txt").is_file()
    assert not (tmp_path / "replays").exists()

    assert_raises(
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

    assert_raises(
        (
            lambda: save_safety_report(report, out, dataset=da_motion, workers=1),
            OutputFolderError,
            (f"{name}: is a symbolic link", "remove it"),
        )
    )
    assert not list(outside.iterdir())
