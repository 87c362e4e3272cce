"""The pages of a release: what they show is what the devkit computes; slow work is for those who wait for it."""

import io
import json
import re
import shutil
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import pytest
from asgi import get
from damaged_releases import Damaged, damaged_release
from PIL import Image
from shown_page import Shown

from deepaccident_devkit import DeepAccident
from deepaccident_devkit._version import __version__
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.explore import Explorer, make_app
from deepaccident_devkit.explore.pages import release
from deepaccident_devkit.explore.pages.answers import part_of
from deepaccident_devkit.explore.pages.release import ANY, TABS, kinds_of
from deepaccident_devkit.maps import kept_town_map, town_map, towns_of
from deepaccident_devkit.overview import overview
from deepaccident_devkit.statistics import dataset_statistics
from deepaccident_devkit.validation import CODES, ValidationReport, release_completeness, validate_release

pytestmark = pytest.mark.slow


class Reader:
    """Asks an explorer for pages, as a browser does that loads a page again when its work is done."""

    def __init__(self, dataset: DeepAccident) -> None:
        self.explorer = Explorer(dataset, workers=1)
        self.app: Any = make_app(self.explorer)

    def page(self, address: str, status: int = 200) -> Shown:
        answer = get(self.app, address)
        assert answer.status == status
        return Shown(answer.text)

    def ready(self, address: str) -> Shown:
        self.page(address)
        assert self.explorer.jobs.wait(60)
        return self.page(address)

    @property
    def begun(self) -> list[str]:
        return [job.name for job in self.explorer.jobs.all()]


@pytest.fixture
def reader(da_b: DeepAccident) -> Iterator[Reader]:
    reader = Reader(da_b)
    yield reader
    reader.explorer.jobs.end()


@pytest.fixture(scope="module")
def damaged(release_root_b: Path, tmp_path_factory: pytest.TempPathFactory) -> Damaged:
    root = tmp_path_factory.mktemp("damaged") / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return damaged_release(root)


@pytest.fixture(scope="module")
def of_damaged(damaged: Damaged) -> Iterator[Reader]:
    reader = Reader(damaged.dataset)
    yield reader
    reader.explorer.jobs.end()


@pytest.fixture(scope="module")
def report(damaged: Damaged) -> ValidationReport:
    return validate_release(damaged.dataset.dataroot, workers=1)


@pytest.fixture
def mapped(da: DeepAccident, tmp_path: Path) -> Iterator[Reader]:
    """Of a release with BEV cameras and without a kept map."""
    shutil.copytree(
        da.dataroot, tmp_path / "release", ignore=shutil.ignore_patterns("Camera_*", "town_map-*", "lidar01")
    )
    reader = Reader(DeepAccident("v1", tmp_path / "release", verbose=False))
    yield reader
    reader.explorer.jobs.end()


# all of them


def test_the_address_ends_in_a_slash(reader: Reader) -> None:
    answer = get(reader.app, "/release")
    assert (answer.status, answer.headers["location"]) == (307, "./release/")


def test_all_links_lead_somewhere(of_damaged: Reader) -> None:
    seen: set[str] = set()
    for tab in TABS:
        here = f"/release/{tab}"
        page = of_damaged.ready(here)
        named = [address for address, _ in page.links if not address.startswith("#")]
        assert not [address for address in named if re.match(r"[a-z]+:|/", address)]
        found = {urljoin(here, address) for address in [*named, *page.loads] if not address.startswith("data:")}
        statistics = {address for address in found if address.endswith(".png")}  # rendered in a test of their own
        for address in sorted(found - seen - statistics):
            assert get(of_damaged.app, address).status in (200, 307), address
        seen |= found
    assert "/release/" in seen
    assert any("/scenario/" in address for address in seen)


@pytest.mark.parametrize("tab", [tab for tab in TABS if tab not in ("maps", "conventions")])
def test_a_page_waits_for_its_work(reader: Reader, tab: str) -> None:
    go_on = threading.Event()
    reader.explorer.jobs.ask("other", "something slow", go_on.wait)
    try:
        page = reader.page(f"/release/{tab}")
        assert "This page loads itself again" in page.text
        assert "Before it: something slow" in page.text
        (place,) = (each for _, each in page.tags if "data-titles" in each)
        (title,) = json.loads(place["data-titles"])
        assert place["data-waiting"] == "../waiting.json"
        assert json.loads(get(reader.app, "/waiting.json").body) == ["something slow", title]
        assert any("waiting.js" in each for each in page.loads)
        assert not page.tables
    finally:
        go_on.set()
    ready = reader.ready(f"/release/{tab}")
    assert "loads itself again" not in ready.text
    assert not [each for _, each in ready.tags if "data-titles" in each]
    assert len(ready.text) > len(page.text)


def test_work_is_begun_for_who_opens_its_page(reader: Reader) -> None:
    assert reader.begun == []
    for address, names in {
        "/release/conventions": [],
        "/release/": ["overview"],
        "/release/files": ["overview", "files"],
        "/release/findings": ["overview", "files", "findings"],
        "/release/findings?severity=note": ["overview", "files", "findings"],
    }.items():
        reader.ready(address)
        assert reader.begun == names


def test_what_fails_is_told(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: object) -> None:
        raise NotAvailableError("the disk <is> gone")

    monkeypatch.setattr(release, "overview", fails)
    page = reader.ready("/release/")
    assert "This cannot be told: the disk <is> gone" in page.text
    assert not page.all("is")


# contents


def test_the_contents_are_the_overviews(of_damaged: Reader, damaged: Damaged) -> None:
    told, page = overview(damaged.dataset), of_damaged.ready("/release/")
    for text in (told.dataroot, told.version, told.layout, told.index, __version__):
        assert text in page.text
    assert page.table("split") == [[name, str(count), str(told.expected[name])] for name, count in told.splits.items()]
    assert page.table("agent") == [[name, str(count), str(told.labelled[name])] for name, count in told.agents.items()]
    assert [row[:3] for row in page.table("channel")] == [
        [name, str(count), str(told.files[name])] for name, count in told.channels.items()
    ]
    assert {row[3] for row in page.table("channel")} == {str(told.samples)}
    assert page.table("table") == [[name, f"{count:,}"] for name, count in told.tables.items()]
    assert page.address_of(damaged.broken) == f"../scenario/{damaged.broken}/"
    of_damaged.page(f"/scenario/{damaged.broken}/")


def test_its_counts_lead_to_as_many_scenarios(of_damaged: Reader, damaged: Damaged) -> None:
    page, told = of_damaged.ready("/release/"), overview(damaged.dataset)
    checked = 0
    for field, values in {"split": told.splits, **told.attributes}.items():
        for value, count in values.items():
            if count:
                address = page.address_of("unknown" if value == "none" else value)
                if field in ("weather", "time_of_day", "road_type", "accident_type"):
                    links = [each for each, _ in page.links if each.startswith(f"../?{field}=")]
                    assert len(links) == len(values)
                    address = links[[*values].index(value)]
                found = get(of_damaged.app, urljoin("/release/", address)).text
                assert re.search(r'<b id="count">(\d+)</b>', found)[1] == str(count), (field, value)
                checked += 1
    assert checked > 12


def test_hostile_names_are_text(own_release: Path) -> None:
    hostile = "<script>alert(1)</script>'\"&"
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    meta = own_release / first["folder"] / first["scenario_type"] / "meta" / f"{first['name']}.txt"
    words = meta.read_text().split(" ", 1)
    meta.write_text(f"{hostile.replace(' ', '')}Noon {words[1]}")
    for path in sorted(own_release.rglob(f"*{first['name']}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", "<i>&Town")))
    for path in own_release.rglob("*.txt"):
        if path.parent.name in ("split_txt_files", own_release.name):
            path.write_text(path.read_text().replace(first["name"], first["name"].replace("Town", "<i>&Town")))
    reader = Reader(DeepAccident("v1", own_release, verbose=False))
    for tab in ("", "findings", "files", "statistics", "maps"):
        page = reader.ready(f"/release/{tab}")
        assert not page.all("i")
        assert all("src" in each for each in page.all("script"))
        if tab in ("", "statistics", "maps"):
            assert "<i>&Town" in page.text
    page = reader.page("/release/")
    assert hostile in page.text
    found = reader.page(urljoin("/release/", page.address_of(hostile)))
    assert "1 of 6 scenarios" in " ".join(found.text.split())


# missing files


def test_missing_files_are_counted(da_partial: DeepAccident) -> None:
    reader = Reader(da_partial)
    told, page = release_completeness(da_partial.dataroot, workers=1), reader.ready("/release/files")
    assert f"{told.total.expected - told.total.missing:,} of their {told.total.expected:,} files" in page.text
    assert f"{told.total.missing:,} are missing" in page.text
    assert [row[:4] for row in page.table("split")] == [
        [name, str(split.scenarios), str(split.expected), str(split.whole)] for name, split in told.splits.items()
    ]
    lidar = next(row for row in page.table("kind") if row[0] == "lidar01")
    samples = len(da_partial.sample)
    absent = samples // 4
    assert lidar[1:] == ["–", "–", "–", "all", "all", str(2 * absent), str(samples + absent)]
    rows = page.table("scenario")
    assert [row[0] for row in rows] == list(told.lacking)
    assert "Camera_Front (12), lidar01 (12)" in rows[0][1]
    assert page.address_of(rows[0][0]) == f"../scenario/{rows[0][0]}/"


def test_a_whole_release_lacks_nothing(da: DeepAccident) -> None:
    page = Reader(da).ready("/release/files")
    assert "4 of them whole" in page.text
    assert len(page.tables) == 1


# findings


def test_findings_are_those_of_validate(of_damaged: Reader, report: ValidationReport) -> None:
    page = of_damaged.ready("/release/findings")
    shown = [each for each in report.findings if each.severity != "note"]
    assert [row[0] for row in page.table("scenario")] == [each.scenario or "the release" for each in shown]
    for row, finding in zip(page.table("scenario"), shown, strict=True):
        assert row[2:] == [finding.code, finding.where, finding.what, finding.remedy]
        assert row[1].startswith(finding.severity)
    assert {row[0]: row[2] for row in page.table("kind")} == {
        kind["code"]: str(kind["count"]) for kind in kinds_of(report.findings)
    }
    assert all(CODES[row[0]].meaning in row[3] for row in page.table("kind"))
    notes = report.counts["note"]
    assert notes
    assert f"{notes} note{'' if notes == 1 else 's'} not shown" in page.text


@pytest.mark.parametrize("severity", ["error", "warning", "note", ANY, "odd", "<b>"])
@pytest.mark.parametrize("code", ["", "label-unreadable", "unlabelled", "<b>"])
def test_findings_are_filtered(of_damaged: Reader, report: ValidationReport, severity: str, code: str) -> None:
    page = of_damaged.ready(f"/release/findings?severity={severity}&code={code}")
    wanted = [each for each in report.findings if severity in (each.severity, ANY) and code in (each.code, "")]
    assert len(page.tables) == 1 + bool(wanted)
    if wanted:
        assert [row[4] for row in page.table("scenario")] == [each.what for each in wanted]
    assert "not shown" not in page.text
    assert re.search(r"(\d+) finding", page.text.rpartition("loads")[2])


def test_the_links_of_kinds_and_severities_filter(of_damaged: Reader, report: ValidationReport) -> None:
    page = of_damaged.ready("/release/findings")
    for kind in kinds_of(report.findings):
        found = of_damaged.page(f"/release/findings{page.address_of(kind['code'])}")
        assert len(found.table("scenario")) == kind["count"]  # notes too
    for severity, count in report.counts.items():
        if count:
            words = f"{count} {severity}{'' if count == 1 else 's'}"
            found = of_damaged.page(f"/release/findings{page.address_of(words)}")
            assert len(found.table("scenario")) == count
            assert of_damaged.page(f"/release/findings{found.address_of(f'{severity} ×')}").text == page.text


def test_long_lists_have_pages(of_damaged: Reader, report: ValidationReport, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "part_of", partial(part_of, size=1))
    page, whats = of_damaged.ready(f"/release/findings?severity={ANY}"), []
    for number in range(1, len(report.findings) + 1):
        whats += [row[4] for row in page.table("scenario")]
        assert f"page {number} of {len(report.findings)}" in page.text
        following = [each["href"] for each in page.all("a") if each.get("rel") == "next"]
        if following:
            page = of_damaged.page(f"/release/findings{following[0]}")
    assert not following
    assert whats == [each.what for each in report.findings]
    for odd, number in {"0": 1, "-1": 1, "x": 1, "²": 1, "9" * 5: len(report.findings), "9" * 99: 1}.items():
        page = of_damaged.page(f"/release/findings?severity={ANY}&page={odd}")
        assert f"page {number} of " in page.text


def test_a_release_without_findings_says_so(da: DeepAccident) -> None:
    assert "None: the files are all there, and agree." in Reader(da).ready("/release/findings").text


# statistics


def test_statistics_are_the_devkits(reader: Reader, da_b: DeepAccident) -> None:
    told, page = dataset_statistics(da_b), reader.ready("/release/statistics")
    (sums,) = [table for table in page.tables if table[0][0] == ""]
    assert sums[0][1:] == list(told.groups)
    assert sums[1] == ["scenarios", *(str(told.scenarios[group]) for group in told.groups)]
    shown = page.tables[1 : 1 + len(told.tables)]
    assert [table[0] for table in shown] == [[str(each) for each in table.rows()[0]] for table in told.tables]
    for table, whole in zip(shown, told.tables, strict=True):
        assert len(table) == len(whole.rows())
    towns = next(table for table in shown if table[0][0] == "town")
    assert towns[1:] == [[str(each) for each in row] for row in told.counts["towns"].rows()[1:]]
    assert [row[0] for row in page.tables[-1][1:]] == [each.scenario for each in told.collisions]


def test_its_figures_are_pictures(reader: Reader) -> None:
    assert get(reader.app, "/release/statistics/ends.png").status == 404
    page = reader.ready("/release/statistics")
    figures = [each for each in page.all("img") if "statistics/" in each["src"]]
    assert len(figures) == 7
    ends = next(each for each in figures if "ends" in each["src"])
    answer = get(reader.app, urljoin("/release/statistics", ends["src"]))
    assert answer.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(answer.body)).size == (int(ends["width"]), int(ends["height"]))
    assert get(reader.app, "/release/statistics/other.png").status == 404


def test_statistics_of_a_selection(reader: Reader, da_b: DeepAccident) -> None:
    town = da_b.scenario[0]["town"]
    chosen = da_b.find(town=town)
    assert 0 < len(chosen) < len(da_b.scenario)
    address = f"/release/statistics?town={town}&view=table&page=1"
    page = reader.ready(address)
    assert f"{len(chosen)} scenarios: town={town}" in " ".join(page.text.split())
    (sums,) = [table for table in page.tables if table[0][0] == ""]
    assert sums[1][1] == str(len(chosen))
    assert page.address_of("Show them") == f"../?town={town}"
    figure = next(each["src"] for each in page.all("img") if "ends" in each["src"])
    assert figure == f"statistics/ends.png?town={town}"
    of_all = get(reader.app, "/release/statistics/ends.png")
    assert of_all.status == 404  # nobody has asked for those of all
    assert get(reader.app, f"/release/{figure}").status == 200
    before = reader.begun
    reader.ready(f"/release/statistics?q=town={town}")  # the same scenarios
    assert reader.begun == before


def test_a_selection_that_makes_no_sense_is_told(reader: Reader) -> None:
    for query, said in {
        "q=tonw=Town03": "scenarios cannot be found by 'tonw'",
        "q=length>=1000": "No scenario matches.",
        "q=<b>": "<b>",
    }.items():
        page = reader.page(f"/release/statistics?{query}")
        assert said in page.text
        assert not [name for name in reader.begun if name.startswith("statistics")]
        assert get(reader.app, f"/release/statistics/ends.png?{query}").status == 404
        assert not page.all("b") or page.all("b") == [{"id": "count"}]


def test_a_selection_waits_for_its_column(reader: Reader) -> None:
    go_on = threading.Event()
    reader.explorer.jobs.ask("other", "something slow", go_on.wait)
    try:
        page = reader.page("/release/statistics?q=min_ttc<1.5")
        assert "min_ttc<1.5: is being computed" in page.text
        (place,) = (each for _, each in page.tags if "data-titles" in each)
        assert "something slow" in json.loads(place["data-titles"])
        assert not [name for name in reader.begun if name.startswith("statistics")]
    finally:
        go_on.set()
    assert reader.explorer.jobs.wait(60)
    assert reader.ready("/release/statistics?q=min_ttc<1.5").tables


# maps


def test_a_map_is_made_for_who_asks_for_it(mapped: Reader) -> None:
    dataset = mapped.explorer.dataset
    towns = towns_of(dataset)
    page = mapped.page("/release/maps")
    assert [each["value"] for each in page.all("button")] == towns
    assert mapped.begun == []
    town = towns[0]
    assert get(mapped.app, f"/release/map/{town}.png").status == 404
    answer = get(mapped.app, f"/release/maps?make={town}")
    assert (answer.status, answer.headers["location"]) == (303, "maps")
    assert mapped.explorer.jobs.wait(60)
    made = kept_town_map(dataset, town)
    assert made is not None
    assert f"It reads up to {made.looks} pictures of {made.scenarios} scenario" in page.text
    page = mapped.page("/release/maps")
    assert [each["value"] for each in page.all("button")] == towns[1:]
    assert f"Read: {made.looks} pictures of {made.scenarios} scenario" in page.text
    picture = get(mapped.app, f"/release/map/{town}.png")
    assert picture.headers["content-type"] == "image/png"
    other = Reader(dataset)
    assert f"map/{town}.png" in other.page("/release/maps").loads
    assert get(other.app, f"/release/map/{town}.png").body == picture.body


def test_a_map_that_cannot_be_kept_is_shown(mapped: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "kept_town_map", lambda *_: None)
    town = towns_of(mapped.explorer.dataset)[0]
    get(mapped.app, f"/release/maps?make={town}")
    assert mapped.explorer.jobs.wait(60)
    assert f"map/{town}.png" in mapped.page("/release/maps").loads
    assert get(mapped.app, f"/release/map/{town}.png").status == 200


def test_no_picture_makes_a_map_anew(mapped: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that has come since is no reason to read all of them while a reader waits for a picture."""
    dataset = mapped.explorer.dataset
    town = towns_of(dataset)[0]
    path = next(Path(dataset.dataroot).rglob("BEV_instance_camera/*/*_001.npz"))
    path.rename(path.with_suffix(".later"))
    town_map(dataset, town)
    path.with_suffix(".later").rename(path)
    monkeypatch.setattr(release, "town_map", lambda *_, **__: pytest.fail("made"))
    assert get(mapped.app, f"/release/map/{town}.png").status == 200


def test_where_no_picture_is_there_is_no_map(reader: Reader, da_b: DeepAccident) -> None:
    town = towns_of(da_b)[0]
    get(reader.app, f"/release/maps?make={town}")
    assert "Being made" in reader.page("/release/maps").text or reader.explorer.jobs.all()[0].is_done
    page = reader.ready("/release/maps")
    assert f"{town}: none of its" in page.text
    assert get(reader.app, "/release/maps?make=Town99").status == 404
    assert get(reader.app, "/release/map/Town99.png").status == 404


# conventions


def test_conventions_name_what_is_there(reader: Reader) -> None:
    page = reader.page("/release/conventions")
    names = {*re.findall(r"\bda\.(\w+)", page.text)}
    assert names >= {"world_from", "ego_from", "transform", "boxes", "load_bev"}
    assert [name for name in names if not hasattr(DeepAccident, name)] == []
    assert [row[0] for row in page.table("orientation")] == ["devkit", "released", "fiery"]
    assert {"world", "ego", "lidar"} < {row[0] for row in page.table("name")}
