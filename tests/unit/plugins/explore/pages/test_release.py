"""The pages of a release show what the devkit computes, and do slow work only for readers who wait
for it.
"""

import json
import re
import shutil
import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import urljoin

import pytest
from support.asgi_client import get_response
from support.damaged_releases import DamagedRelease, damage_release
from support.html_page import ParsedPage
from support.text_contents import missing_parts

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.maps import town_map, towns_of
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.plugins.explore.pages import release
from deepaccident_devkit.plugins.explore.pages.release import TABS
from deepaccident_devkit.statistics.overview import overview
from deepaccident_devkit.support.human_names import human_name

pytestmark = pytest.mark.slow


class Reader:
    """Request pages as a browser does, which loads a page again when its work is done."""

    def __init__(self, dataset: DeepAccident) -> None:
        self.explorer = Explorer(dataset, workers=1)
        self.app: Any = make_app(self.explorer)

    def page(self, address: str) -> ParsedPage:
        response = get_response(self.app, address)
        assert response.status == 200
        return ParsedPage(response.text)

    def ready(self, address: str) -> ParsedPage:
        self.page(address)
        assert self.explorer.jobs.wait(60)
        return self.page(address)


def open_reader(dataset: DeepAccident, request: pytest.FixtureRequest) -> Reader:
    """Open a reader; its work ends with the test or the fixture that requests it."""
    reader = Reader(dataset)
    request.addfinalizer(reader.explorer.jobs.end)
    return reader


@pytest.fixture
def reader(da_b: DeepAccident, request: pytest.FixtureRequest) -> Reader:
    return open_reader(da_b, request)


@pytest.fixture(scope="module")
def damaged(release_root_b: Path, tmp_path_factory: pytest.TempPathFactory) -> DamagedRelease:
    root = tmp_path_factory.mktemp("damaged") / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return damage_release(root)


@pytest.fixture(scope="module")
def damaged_reader(damaged: DamagedRelease, request: pytest.FixtureRequest) -> Reader:
    return open_reader(damaged.dataset, request)


@pytest.fixture
def mapless_reader(da: DeepAccident, tmp_path: Path, request: pytest.FixtureRequest) -> Reader:
    """Return a reader of a release with BEV cameras and without a stored map."""
    shutil.copytree(
        da.dataroot,
        tmp_path / "release",
        ignore=shutil.ignore_patterns("Camera_*", "town_maps", "lidar01"),
    )
    return open_reader(DeepAccident("v1", tmp_path / "release", verbose=False), request)


# all pages


def test_all_links_lead_somewhere(damaged_reader: Reader) -> None:
    targets: set[str] = set()
    for tab in TABS:
        page = damaged_reader.ready(f"/release/{tab}")
        links = [address for address, _ in page.links if not address.startswith("#")]
        loads = [address for address in page.loads if not address.startswith("data:")]
        assert not [address for address in links if re.match(r"[a-z]+:|/", address)]
        targets |= {urljoin(f"/release/{tab}", address) for address in (*links, *loads)}
    for target in targets:
        assert get_response(damaged_reader.app, target).status in (200, 307), target
    assert not missing_parts(" ".join(targets), "/release/", "/scenario/")


def test_a_page_waits_for_its_work(reader: Reader) -> None:
    go_on = threading.Event()
    reader.explorer.jobs.ask("other", "something slow", go_on.wait)
    page = reader.page("/release/")
    waiting_titles = json.loads(get_response(reader.app, "/waiting.json").body)
    go_on.set()
    assert "This page loads itself again" in page.text
    assert page.tables == []
    (titles,) = [attributes["data-titles"] for attributes in waiting_elements(page)]
    assert waiting_titles == ["something slow", *json.loads(titles)]
    assert waiting_elements(reader.ready("/release/")) == []


def waiting_elements(page: ParsedPage) -> list[dict[str, str]]:
    return [attributes for _, attributes in page.tags if "data-titles" in attributes]


def test_a_failure_is_shown_on_the_page(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    error = NotAvailableError("the disk <is> gone")
    monkeypatch.setattr(release, "overview", Mock(side_effect=error))
    page = reader.ready("/release/")
    assert "Not available: the disk <is> gone" in page.text
    assert page.all("is") == []


# contents


def test_the_contents_are_the_overviews(damaged_reader: Reader, damaged: DamagedRelease) -> None:
    page, summary = damaged_reader.ready("/release/"), overview(damaged.dataset)
    facts = (summary.dataroot, summary.version, summary.layout, summary.index)
    assert not missing_parts(page.text, *facts, __version__)
    for heading, counts, second_counts in (
        ("split", summary.splits, summary.expected),
        ("agent", summary.agents, summary.labelled),
        ("channel", summary.channels, summary.files),
    ):
        rows = []
        for name, count in counts.items():
            shown_name = human_name(name) if heading == "agent" else name
            rows.append([shown_name, str(count), str(second_counts[name])])
        assert [row[:3] for row in page.table(heading)] == rows
    assert {row[3] for row in page.table("channel")} == {str(summary.samples)}
    assert page.table("table") == [[name, f"{count:,}"] for name, count in summary.tables.items()]
    assert page.address_of(damaged.broken) == f"../scenario/{damaged.broken}/"
    damaged_reader.page(f"/scenario/{damaged.broken}/")


def test_each_count_leads_to_as_many_scenarios(
    damaged_reader: Reader, damaged: DamagedRelease
) -> None:
    page, summary = damaged_reader.ready("/release/"), overview(damaged.dataset)
    for field, counts in {"split": summary.splits, **summary.attributes}.items():
        links = [address for address, _ in page.links if address.startswith(f"../?{field}=")]
        for index, (value, count) in enumerate(counts.items()):
            if not count:
                continue
            address = page.address_of("unknown" if value == "none" else human_name(value))
            if field in ("weather", "time_of_day", "road_type", "accident_type"):
                assert len(links) == len(counts)
                address = links[index]
            text = get_response(damaged_reader.app, urljoin("/release/", address)).text
            assert re.findall(r'<b id="count">(\d+)</b>', text) == [str(count)], (field, value)


def test_values_that_would_find_nothing_are_no_filters(reader: Reader) -> None:
    page = get_response(reader.app, "/?collision=true").text
    filters = re.findall(
        r'name="(\w+)" value="[^"]*"(?: checked)?>\n<span>.*?</span> <b>(\d+)</b>', page
    )
    assert {name for name, _ in filters} > {"town", "collision"}
    assert [name for name, count in filters if count == "0"] == []


def test_hostile_names_are_text(own_release: Path, request: pytest.FixtureRequest) -> None:
    weather = "<script>alert(1)</script>'\"&"
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    name = first["name"]
    hostile_name = name.replace("Town", "<i>&Town")
    meta = own_release / first["folder"] / first["scenario_type"] / "meta" / f"{name}.txt"
    _, other_words = meta.read_text().split(" ", 1)
    meta.write_text(f"{weather}Noon {other_words}")
    for path in sorted(own_release.rglob(f"*{name}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", "<i>&Town")))
    for path in own_release.rglob("*.txt"):
        if path.parent.name in ("split_txt_files", own_release.name):
            path.write_text(path.read_text().replace(name, hostile_name))

    reader = open_reader(DeepAccident("v1", own_release, verbose=False), request)
    for tab in ("", "maps"):
        page = reader.ready(f"/release/{tab}")
        assert page.all("i") == []
        assert [script for script in page.all("script") if "src" not in script] == []
        assert "<i>&Town" in page.text


# maps


def test_stored_maps_are_shown(mapless_reader: Reader) -> None:
    app, dataset = mapless_reader.app, mapless_reader.explorer.dataset
    town, *other_towns = towns_of(dataset)
    picture = f"/release/map/{town}.png"
    page = mapless_reader.page("/release/maps")
    assert page.text.count("Not made yet") == len(other_towns) + 1
    assert get_response(app, picture).status == 404

    town_map(dataset, town)
    page = mapless_reader.page("/release/maps")
    assert page.text.count("Not made yet") == len(other_towns)
    assert f"map/{town}.png" in page.loads
    assert get_response(app, picture).headers["content-type"] == "image/png"
    assert get_response(app, "/release/map/Town99.png").status == 404
