"""The pages of a release: what they show is what the devkit computes; slow work is for those who
wait for it.
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
from asgi import get
from damaged_releases import Damaged, damaged_release
from shown_page import Shown
from wording import lacking

from deepaccident_devkit import DeepAccident, __version__
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.maps import town_map, towns_of
from deepaccident_devkit.plugins.explore import Explorer, make_app
from deepaccident_devkit.plugins.explore.pages import release
from deepaccident_devkit.plugins.explore.pages.release import TABS
from deepaccident_devkit.statistics.overview import overview

pytestmark = pytest.mark.slow


class Reader:
    """Asks an explorer for pages, as a browser does that loads a page again when its work is
    done.
    """

    def __init__(self, dataset: DeepAccident) -> None:
        self.explorer = Explorer(dataset, workers=1)
        self.app: Any = make_app(self.explorer)

    def page(self, address: str) -> Shown:
        answer = get(self.app, address)
        assert answer.status == 200
        return Shown(answer.text)

    def ready(self, address: str) -> Shown:
        self.page(address)
        assert self.explorer.jobs.wait(60)
        return self.page(address)


def reading(dataset: DeepAccident, request: pytest.FixtureRequest) -> Reader:
    """A reader of it, whose work ends with the test or the fixture."""
    reader = Reader(dataset)
    request.addfinalizer(reader.explorer.jobs.end)
    return reader


@pytest.fixture
def reader(da_b: DeepAccident, request: pytest.FixtureRequest) -> Reader:
    return reading(da_b, request)


@pytest.fixture(scope="module")
def damaged(release_root_b: Path, tmp_path_factory: pytest.TempPathFactory) -> Damaged:
    root = tmp_path_factory.mktemp("damaged") / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    return damaged_release(root)


@pytest.fixture(scope="module")
def of_damaged(damaged: Damaged, request: pytest.FixtureRequest) -> Reader:
    return reading(damaged.dataset, request)


@pytest.fixture
def mapped(da: DeepAccident, tmp_path: Path, request: pytest.FixtureRequest) -> Reader:
    """Of a release with BEV cameras and without a kept map."""
    shutil.copytree(
        da.dataroot,
        tmp_path / "release",
        ignore=shutil.ignore_patterns("Camera_*", "town_maps", "lidar01"),
    )
    return reading(DeepAccident("v1", tmp_path / "release", verbose=False), request)


# all of them


def test_all_links_lead_somewhere(of_damaged: Reader) -> None:
    seen: set[str] = set()
    for tab in TABS:
        page = of_damaged.ready(f"/release/{tab}")
        named = [address for address, _ in page.links if not address.startswith("#")]
        assert not [address for address in named if re.match(r"[a-z]+:|/", address)]
        loads = [address for address in page.loads if not address.startswith("data:")]
        seen |= {urljoin(f"/release/{tab}", address) for address in (*named, *loads)}
    assert [
        each for each in sorted(seen) if get(of_damaged.app, each).status not in (200, 307)
    ] == []
    assert not lacking(" ".join(seen), "/release/", "/scenario/")


def test_a_page_waits_for_its_work(reader: Reader) -> None:
    go_on = threading.Event()
    reader.explorer.jobs.ask("other", "something slow", go_on.wait)
    page, waiting = reader.page("/release/"), json.loads(get(reader.app, "/waiting.json").body)
    go_on.set()
    assert ("This page loads itself again" in page.text, page.tables) == (True, [])
    (place,) = (each for _, each in page.tags if "data-titles" in each)
    assert waiting == ["something slow", *json.loads(place["data-titles"])]
    assert [each for _, each in reader.ready("/release/").tags if "data-titles" in each] == []


def test_what_fails_is_told(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        release, "overview", Mock(side_effect=NotAvailableError("the disk <is> gone"))
    )
    page = reader.ready("/release/")
    assert ("This cannot be told: the disk <is> gone" in page.text, page.all("is")) == (True, [])


# contents


def test_the_contents_are_the_overviews(of_damaged: Reader, damaged: Damaged) -> None:
    told, page = overview(damaged.dataset), of_damaged.ready("/release/")
    assert not lacking(page.text, told.dataroot, told.version, told.layout, told.index, __version__)
    assert {
        heading: [row[:3] for row in page.table(heading)]
        for heading in ("split", "agent", "channel")
    } == {
        "split": [
            [name, str(count), str(told.expected[name])] for name, count in told.splits.items()
        ],
        "agent": [
            [name, str(count), str(told.labelled[name])] for name, count in told.agents.items()
        ],
        "channel": [
            [name, str(count), str(told.files[name])] for name, count in told.channels.items()
        ],
    }
    assert {row[3] for row in page.table("channel")} == {str(told.samples)}
    assert page.table("table") == [[name, f"{count:,}"] for name, count in told.tables.items()]
    assert page.address_of(damaged.broken) == f"../scenario/{damaged.broken}/"
    of_damaged.page(f"/scenario/{damaged.broken}/")


def test_its_counts_lead_to_as_many_scenarios(of_damaged: Reader, damaged: Damaged) -> None:
    page, told = of_damaged.ready("/release/"), overview(damaged.dataset)
    counted, found = {}, {}
    for field, values in {"split": told.splits, **told.attributes}.items():
        links = [each for each, _ in page.links if each.startswith(f"../?{field}=")]
        for value in (each for each, count in values.items() if count):
            address = page.address_of("unknown" if value == "none" else value)
            if field in ("weather", "time_of_day", "road_type", "accident_type"):
                assert len(links) == len(values)
                address = links[[*values].index(value)]
            (shown,) = re.findall(
                r'<b id="count">(\d+)</b>', get(of_damaged.app, urljoin("/release/", address)).text
            )
            counted[field, value], found[field, value] = values[value], int(shown)
    assert found == counted


def test_values_that_would_find_nothing_are_no_filters(reader: Reader) -> None:
    page = get(reader.app, "/?collision=true").text
    counts = re.findall(
        r'name="(\w+)" value="([^"]*)"( checked)?>\n<span>.*?</span> <b>(\d+)</b>', page
    )
    assert {name for name, *_ in counts} > {"town", "collision"}
    assert [each for each in counts if each[3] == "0"] == []


def test_hostile_names_are_text(own_release: Path, request: pytest.FixtureRequest) -> None:
    hostile = "<script>alert(1)</script>'\"&"
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    meta = own_release / first["folder"] / first["scenario_type"] / "meta" / f"{first['name']}.txt"
    meta.write_text(f"{hostile.replace(' ', '')}Noon {meta.read_text().split(' ', 1)[1]}")
    for path in sorted(own_release.rglob(f"*{first['name']}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", "<i>&Town")))
    for path in own_release.rglob("*.txt"):
        if path.parent.name in ("split_txt_files", own_release.name):
            path.write_text(
                path.read_text().replace(first["name"], first["name"].replace("Town", "<i>&Town"))
            )
    reader = reading(DeepAccident("v1", own_release, verbose=False), request)
    for tab in ("", "maps"):
        page = reader.ready(f"/release/{tab}")
        assert (
            page.all("i"),
            [script for script in page.all("script") if "src" not in script],
        ) == ([], [])
        assert "<i>&Town" in page.text


# maps


def test_maps_that_are_kept_are_shown(mapped: Reader) -> None:
    town, *others = towns_of(mapped.explorer.dataset)
    before, picture = mapped.page("/release/maps"), f"/release/map/{town}.png"
    assert (before.text.count("Not made yet"), get(mapped.app, picture).status) == (
        len(others) + 1,
        404,
    )
    town_map(mapped.explorer.dataset, town)
    page = mapped.page("/release/maps")
    assert page.text.count("Not made yet") == len(others)
    assert f"map/{town}.png" in page.loads
    assert get(mapped.app, picture).headers["content-type"] == "image/png"
    assert get(mapped.app, "/release/map/Town99.png").status == 404


# conventions
