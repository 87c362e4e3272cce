"""Pages as files: they say what served pages say, need nothing else, and are there as a whole or
not at all.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urljoin

import pytest
from damaged_releases import damaged_release
from evaluation_runs import stored_run
from refusals import assert_refused
from replay_page import accident, data_of, normal
from shown_page import Shown, shown
from wording import holding, lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.explore import Explorer, export_pages, static_pages
from deepaccident_devkit.plugins.explore.pages.scenario import PARTS, part_html
from deepaccident_devkit.render.captions import scenario_words

pytestmark = pytest.mark.slow

SVG = "http://www.w3.org/2000/svg"
"""A name, which no browser opens."""


class Made(NamedTuple):
    """An export with two bundles and results without one, and what it was made from."""

    index: Path
    given: dict[str, list[Path]]

    def page(self, token: str) -> Shown:
        return shown(self.index.parent / token / "index.html")

    def replay(self, token: str) -> dict[str, Any]:
        return data_of(self.index.parent / token / "replay.html")


@pytest.fixture(scope="module")
def made(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("made")
    run, _ = stored_run(
        da_motion, EvaluationSetup(task="accident", protocol="boxes"), folder / "first.json"
    )
    stored_run(da_motion, EvaluationSetup(task="motion"), folder / "maps")
    detection, _ = stored_run(da_motion, EvaluationSetup(task="detection"), folder / "boxes.json")
    bundles = [
        save_run(detection, folder / "boxes"),
        save_run(run, folder / "first", include_results=True),
    ]
    given = {"bundles": bundles, "results": [folder / "boxes.json", folder / "maps"]}
    return Made(export_pages(da_motion, folder / "out", **given, workers=1), given)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_what_is_written(made: Made, da_motion: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_motion.scenario]
    of_scenarios = [
        f"{token}/{name}"
        for token in tokens
        for name in ("index.html", "replay.html", "thumbnail.jpg")
    ]
    found = contents(made.index.parent)
    static = {"explore.css", "keys.js", "pages.css", "sorting.js"}
    assert found.keys() == {
        "index.html",
        ".deepaccident_pages",
        *of_scenarios,
        *(f"static/{each}" for each in static),
    }
    assert [path.name for path in made.index.parent.parent.glob(".*")] == []


def test_all_links_lead_to_files(made: Made) -> None:
    root, reached = made.index.parent, set()
    for page in root.rglob("index.html"):
        told = shown(page)
        addresses = [
            each
            for each in (*(address for address, _ in told.links), *told.loads)
            if each[:5] != "data:"
        ]
        assert not [each for each in addresses if each.startswith("/")]
        reached |= {
            unquote(urljoin(page.as_uri(), each)).removeprefix("file://")
            for each in addresses
            if each[0] != "#"
        }
    assert reached == {
        str(path)
        for path in root.rglob("*")
        if path.is_file() and path.name != ".deepaccident_pages"
    }


def test_nothing_needs_a_network_or_tells_where_the_release_lies(
    made: Made, da_motion: DeepAccident
) -> None:
    for name, content in contents(made.index.parent).items():
        text = content.decode(errors="replace").replace(SVG, "")
        assert not re.search(r"https?:|//[a-z]+\.", text), name
        assert not holding(text, str(da_motion.dataroot), str(made.index.parent)), name
    for page in made.index.parent.rglob("index.html"):
        (policy,) = [each["content"] for each in shown(page).all("meta") if "http-equiv" in each]
        assert policy.startswith("default-src 'none'; script-src 'self' file:;")
        assert not holding(policy, "unsafe", "connect-src")


def test_the_list_has_the_scenarios_and_their_values(made: Made, da_motion: DeepAccident) -> None:
    told, explorer = shown(made.index), Explorer(da_motion)
    explorer.scenarios.begin()
    assert explorer.jobs.wait(60)
    expected = []
    for record in da_motion.scenario:
        place = explorer.scenarios.row_of[record["token"]]
        visibility, lead = (
            explorer.scenarios.values(name)[place] for name in ("accident_visibility", "lead")
        )
        where = [record["token"], scenario_words(record), "train", "35"]
        expected.append([*where, visibility or "–", "–" if lead is None else f"{lead:.1f}"])
    explorer.jobs.end()
    assert [row[:6] for row in told.table("scenario")] == expected


@pytest.mark.parametrize("which", [accident, normal])
def test_a_page_has_all_parts(made: Made, da_motion: DeepAccident, which: Any) -> None:
    token = which(da_motion)
    page, explorer = made.page(token), Explorer(da_motion)
    parts = {
        name: " ".join(Shown(part_html(explorer, token, name, "../../../")).text.split())
        for name in PARTS
    }
    assert not lacking(
        page.text,
        *PARTS.values(),
        *[f"{name}{value}" for name, value in made.replay(token)["facts"]],
    )
    assert not lacking(
        " ".join(page.text.split()), *(parts[name] for name in parts if name != "findings")
    )
    assert [each["src"] for each in page.all("iframe")] == ["replay.html"]
    assert page.address_of("Its twin").startswith("../../type1_subtype1_")


def test_the_same_call_gives_the_same_bytes(
    made: Made, da_motion: DeepAccident, tmp_path: Path
) -> None:
    again = export_pages(da_motion, tmp_path / "another name", **made.given, workers=2)
    assert contents(again.parent) == contents(made.index.parent)


# which scenarios


@pytest.fixture
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(static_pages, "tried_replay", lambda *_, **__: "not in this test")


def listed(index: Path) -> list[str]:
    return [row[0] for row in shown(index).table("scenario")]


@pytest.mark.usefixtures("_quickly")
def test_scenarios_are_chosen_by_filters_and_by_name(da_b: DeepAccident, tmp_path: Path) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    wanted = [scenario["token"] for scenario in da_b.find("collision=true")]
    index = export_pages(da_b, tmp_path / "a", where=["collision=true", "length>=1"], workers=1)
    assert listed(index) == wanted
    index = export_pages(
        da_b, tmp_path / "b", scenarios=[da_b.scenario[4], tokens[1], tokens[4]], workers=1
    )
    (found,) = re.findall(r"da\.find\('(.*?)'\)", shown(index).text)
    assert listed(index) == [tokens[4], tokens[1]]
    assert {each["token"] for each in da_b.find(found)} == {tokens[4], tokens[1]}
    index = export_pages(
        da_b, tmp_path / "c", scenarios=tokens[::-1], where=["collision=true"], workers=1
    )
    assert listed(index) == wanted[::-1]
    assert (
        "There is no replay: not in this test"
        in shown(tmp_path / "c" / wanted[0] / "index.html").text
    )


def test_what_cannot_be_exported(
    da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(static_pages, "MAX_SCENARIOS", 3)

    def export(**chosen: Any) -> Callable[[], object]:
        return lambda: export_pages(da_b, tmp_path / "out", **chosen)

    assert_refused(
        (export(), ConfigError, ("6 scenarios", "at most 3", "--where")),
        (export(where=["length>=1000"]), NotAvailableError, ("no scenario matches",)),
        (export(scenarios=[]), NotAvailableError, ("no scenario matches",)),
        (export(scenarios=["no such"]), TokenError, ("no such",)),
        (export(where=["collision=true"], workers=0), ChoiceError, ("workers",)),
    )
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("_quickly")
def test_hostile_names_are_text(own_release: Path, tmp_path: Path) -> None:
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    hostile = "<img src=x onerror=alert(1)>'\"&?#%41 .."
    for path in sorted(own_release.rglob(f"*{first['name']}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", f"{hostile}Town")))
    dataset = DeepAccident("v1", own_release, verbose=False)
    token = next(scenario["token"] for scenario in dataset.scenario if hostile in scenario["name"])
    page = shown(export_pages(dataset, tmp_path / "out", scenarios=[token], workers=1))
    assert [each["src"] for each in page.all("img")] == [
        address for address in page.loads if address.endswith("jpg")
    ]
    assert page.table("scenario")[0][0] == token
    (folder,) = (tmp_path / "out").glob("type*/*")
    assert re.fullmatch(r"[A-Za-z0-9_.-]+", folder.name)
    assert shown(folder / "index.html").all("img") == []
    assert (tmp_path / "out" / unquote(page.address_of(token))).is_file()


def test_a_damaged_release(own_release: Path, tmp_path: Path) -> None:
    damaged = damaged_release(own_release)
    index = export_pages(damaged.dataset, tmp_path / "out", workers=1)
    assert listed(index) == [scenario["token"] for scenario in damaged.dataset.scenario]
    assert damaged.broken not in listed(index)
    assert "meta-missing" in shown(tmp_path / "out" / damaged.without_meta / "index.html").text
    told = {
        name: content.decode(errors="replace")
        for name, content in contents(tmp_path / "out").items()
    }
    told |= {
        page: shown(page).text for page in (tmp_path / "out").rglob("index.html")
    }  # names are not broken in these
    assert [place for place, text in told.items() if str(own_release) in text] == []


# the folder


@pytest.fixture
def one(da_b: DeepAccident, _quickly: None) -> dict[str, Any]:
    """Arguments for an export of a scenario without a replay."""
    return {"dataset": da_b, "scenarios": [da_b.scenario[0]], "workers": 1}


def test_an_earlier_export_is_replaced(
    one: dict[str, Any], da_b: DeepAccident, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    export_pages(folder=out, **one)
    other = one | {"scenarios": [da_b.scenario[1]]}
    export_pages(folder=out, **other)
    export_pages(folder=tmp_path / "fresh", **other)
    assert contents(out) == contents(tmp_path / "fresh")


def test_other_files_are_never_touched(one: dict[str, Any], tmp_path: Path) -> None:
    out, notes = tmp_path / "out", tmp_path / "out" / "static" / "notes.txt"
    export_pages(folder=out, **one)
    before = contents(out)

    def again() -> None:
        export_pages(folder=out, **one)

    notes.write_text("mine")
    assert_refused((again, ConfigError, ("static/notes.txt", "which no export wrote")))
    assert notes.read_text() == "mine"
    notes.unlink()
    (out / "link").symlink_to(tmp_path)
    assert_refused((again, ConfigError, ("holds link", "which no export wrote")))
    (out / "link").unlink()
    assert contents(out) == before


def test_folders_that_cannot_be(one: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")

    def export(folder: Path | str) -> Callable[[], object]:
        return lambda: export_pages(folder=folder, **one)

    assert_refused(
        (export(tmp_path / "file"), ConfigError, ("is a file",)),
        (export(tmp_path / "file" / "below"), ConfigError, ("is a file",)),
        (export(tmp_path), ConfigError, ("holds file", "which no export wrote")),
        (export(""), ConfigError, ("an empty path",)),
    )
    assert contents(tmp_path) == {"file": b"mine"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_export_leaves_nothing(
    one: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    kept = tmp_path / "kept"
    export_pages(folder=kept, **one)
    before = contents(tmp_path)

    def interrupted() -> dict[str, str]:
        assert len([*tmp_path.rglob("thumbnail.jpg")]) == 2  # something was written
        raise error

    monkeypatch.setattr(static_pages, "assets", interrupted)
    for folder in (kept, tmp_path / "new"):
        with pytest.raises(error):
            export_pages(folder=folder, **one)
        assert (contents(tmp_path), [path.name for path in tmp_path.iterdir()]) == (
            before,
            ["kept"],
        )
