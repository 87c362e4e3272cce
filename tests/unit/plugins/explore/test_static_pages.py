"""Pages as files say the same as served pages, need nothing else, and are written completely or not
at all.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urljoin

import pytest
from support.damaged_releases import damage_release
from support.evaluation_runs import stored_run
from support.expected_errors import assert_raises
from support.html_page import ParsedPage, parse_page
from support.replay_page import accident_scenario, normal_scenario, read_page_data
from support.text_contents import contained_parts, missing_parts
from support.tiny_release_index import folder_contents

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.plugins.explore import Explorer, export_pages, static_pages
from deepaccident_devkit.plugins.explore.pages.scenario import PARTS, part_html
from deepaccident_devkit.render.captions import scenario_words
from deepaccident_devkit.support.human_names import human_name

pytestmark = pytest.mark.slow

SVG = "http://www.w3.org/2000/svg"
"""The name of a namespace, which no browser opens."""


class Export(NamedTuple):
    """Exported pages with two bundles and results without one, and the models behind them."""

    index: Path
    models: dict[str, list[Path]]

    def page(self, token: str) -> ParsedPage:
        return parse_page(self.index.parent / token / "index.html")

    def replay(self, token: str) -> dict[str, Any]:
        return read_page_data(self.index.parent / token / "replay.html")


@pytest.fixture(scope="module")
def export(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Export:
    folder = tmp_path_factory.mktemp("made")
    accident_setup = EvaluationSetup(task="accident", protocol="boxes")
    accident, _ = stored_run(da_motion, accident_setup, folder / "first.json")
    stored_run(da_motion, EvaluationSetup(task="motion"), folder / "maps")
    detection, _ = stored_run(da_motion, EvaluationSetup(task="detection"), folder / "boxes.json")
    bundles = [
        save_run(detection, folder / "boxes"),
        save_run(accident, folder / "first", include_results=True),
    ]
    models = {"bundles": bundles, "results": [folder / "boxes.json", folder / "maps"]}
    return Export(export_pages(da_motion, folder / "out", **models, workers=1), models)


def test_an_export_has_a_list_static_files_and_a_folder_for_each_scenario(
    export: Export, da_motion: DeepAccident
) -> None:
    root = export.index.parent
    expected = {"index.html", ".deepaccident_pages"}
    expected |= {f"static/{name}" for name in ("explore.css", "keys.js", "pages.css", "sorting.js")}
    for scenario in da_motion.scenario:
        for name in ("index.html", "replay.html", "thumbnail.jpg"):
            expected.add(f"{scenario['token']}/{name}")
    assert folder_contents(root).keys() == expected
    assert [path.name for path in root.parent.glob(".*")] == []


def test_all_links_lead_to_files(export: Export) -> None:
    root = export.index.parent
    linked_files = set()
    for path in root.rglob("index.html"):
        page = parse_page(path)
        addresses = [address for address, _ in page.links] + page.loads
        for address in addresses:
            assert not address.startswith("/")
            if not address.startswith(("data:", "#")):
                url = urljoin(path.as_uri(), address)
                linked_files.add(unquote(url).removeprefix("file://"))

    files = {str(path) for path in root.rglob("*") if path.is_file()}
    assert linked_files == files - {str(root / ".deepaccident_pages")}


def test_nothing_needs_a_network_or_tells_where_the_release_lies(
    export: Export, da_motion: DeepAccident
) -> None:
    root = export.index.parent
    for name, content in folder_contents(root).items():
        text = content.decode(errors="replace").replace(SVG, "")
        assert not re.search(r"https?:|//[a-z]+\.", text), name
        assert not contained_parts(text, str(da_motion.dataroot), str(root)), name
    for path in root.rglob("index.html"):
        metas = parse_page(path).all("meta")
        (policy,) = [meta["content"] for meta in metas if "http-equiv" in meta]
        assert policy.startswith("default-src 'none'; script-src 'self' file:;")
        assert not contained_parts(policy, "unsafe", "connect-src")


def test_the_list_has_the_scenarios_and_their_values(
    export: Export, da_motion: DeepAccident
) -> None:
    explorer = Explorer(da_motion)
    explorer.scenarios.begin()
    assert explorer.jobs.wait(60)
    scenarios = explorer.scenarios
    expected = []
    for record in da_motion.scenario:
        row = scenarios.row_of[record["token"]]
        visibility = human_name(scenarios.values("accident_visibility")[row] or "–", "values")
        lead = scenarios.values("lead")[row]
        lead_text = "–" if lead is None else f"{lead:.1f}"
        words = scenario_words(record)
        expected.append([record["token"], words, "train", "35", visibility, lead_text])
    explorer.jobs.end()
    assert [row[:6] for row in parse_page(export.index).table("scenario")] == expected


@pytest.mark.parametrize("select_scenario", [accident_scenario, normal_scenario])
def test_a_page_has_all_parts(
    export: Export, da_motion: DeepAccident, select_scenario: Any
) -> None:
    token = select_scenario(da_motion)
    page, explorer = export.page(token), Explorer(da_motion)
    facts = [f"{name}{value}" for name, value in export.replay(token)["facts"]]
    assert not missing_parts(page.text, *PARTS.values(), *facts)

    page_text = " ".join(page.text.split())
    for name in PARTS:
        part = ParsedPage(part_html(explorer, token, name, "../../../"))
        assert name == "findings" or " ".join(part.text.split()) in page_text
    assert [frame["src"] for frame in page.all("iframe")] == ["replay.html"]
    assert page.address_of("Its twin").startswith("../../type1_subtype1_")


def test_the_same_call_gives_the_same_bytes(
    export: Export, da_motion: DeepAccident, tmp_path: Path
) -> None:
    index = export_pages(da_motion, tmp_path / "another name", **export.models, workers=2)
    assert folder_contents(index.parent) == folder_contents(export.index.parent)


# selection of scenarios


@pytest.fixture
def _without_replays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(static_pages, "tried_replay", lambda *_, **__: "not in this test")


def listed_scenarios(index: Path) -> list[str]:
    return [row[0] for row in parse_page(index).table("scenario")]


@pytest.mark.usefixtures("_without_replays")
def test_scenarios_are_chosen_by_filters_and_by_name(da_b: DeepAccident, tmp_path: Path) -> None:
    tokens = [scenario["token"] for scenario in da_b.scenario]
    accidents = [scenario["token"] for scenario in da_b.find("collision=true")]
    index = export_pages(da_b, tmp_path / "a", where=["collision=true", "length>=1"], workers=1)
    assert listed_scenarios(index) == accidents

    selected = [da_b.scenario[4], tokens[1], tokens[4]]
    index = export_pages(da_b, tmp_path / "b", scenarios=selected, workers=1)
    (where,) = re.findall(r"da\.find\('(.*?)'\)", parse_page(index).text)
    assert listed_scenarios(index) == [tokens[4], tokens[1]]
    assert {scenario["token"] for scenario in da_b.find(where)} == {tokens[4], tokens[1]}

    index = export_pages(
        da_b, tmp_path / "c", scenarios=tokens[::-1], where=["collision=true"], workers=1
    )
    assert listed_scenarios(index) == accidents[::-1]
    page = parse_page(tmp_path / "c" / accidents[0] / "index.html")
    assert "There is no replay: not in this test" in page.text


def test_impossible_selections_are_refused(
    da_b: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(static_pages, "MAX_SCENARIOS", 3)

    def exporter(**options: Any) -> Callable[[], object]:
        return lambda: export_pages(da_b, tmp_path / "out", **options)

    assert_raises(
        (exporter(), ConfigError, ("6 scenarios", "at most 3", "--where")),
        (exporter(where=["length>=1000"]), NotAvailableError, ("no scenario matches",)),
        (exporter(scenarios=[]), NotAvailableError, ("no scenario matches",)),
        (exporter(scenarios=["no such"]), TokenError, ("no such",)),
        (exporter(where=["collision=true"], workers=0), ChoiceError, ("workers",)),
    )
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("_without_replays")
def test_hostile_names_are_text(own_release: Path, tmp_path: Path) -> None:
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    hostile = "<img src=x onerror=alert(1)>'\"&?#%41 .."
    for path in sorted(own_release.rglob(f"*{first['name']}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", f"{hostile}Town")))
    dataset = DeepAccident("v1", own_release, verbose=False)
    token = next(scenario["token"] for scenario in dataset.scenario if hostile in scenario["name"])

    page = parse_page(export_pages(dataset, tmp_path / "out", scenarios=[token], workers=1))
    thumbnails = [address for address in page.loads if address.endswith("jpg")]
    assert [image["src"] for image in page.all("img")] == thumbnails
    assert page.table("scenario")[0][0] == token
    (folder,) = (tmp_path / "out").glob("type*/*")
    assert re.fullmatch(r"[A-Za-z0-9_.-]+", folder.name)
    assert parse_page(folder / "index.html").all("img") == []
    assert (tmp_path / "out" / unquote(page.address_of(token))).is_file()


def test_a_damaged_release_is_exported_without_its_broken_scenario(
    own_release: Path, tmp_path: Path
) -> None:
    damaged = damage_release(own_release)
    out = tmp_path / "out"
    tokens = listed_scenarios(export_pages(damaged.dataset, out, workers=1))
    assert tokens == [scenario["token"] for scenario in damaged.dataset.scenario]
    assert damaged.broken not in tokens
    assert "meta-missing" in parse_page(out / damaged.without_meta / "index.html").text
    for path in out.rglob("*"):
        if path.is_file():
            assert str(own_release) not in path.read_text(errors="replace"), path
        if path.name == "index.html":  # the text has no tags that split a path
            assert str(own_release) not in parse_page(path).text, path


# output folder


@pytest.fixture
def arguments(da_b: DeepAccident, _without_replays: None) -> dict[str, Any]:
    """Return arguments for an export of one scenario without a replay."""
    return {"dataset": da_b, "scenarios": [da_b.scenario[0]], "workers": 1}


def test_an_earlier_export_is_replaced(
    arguments: dict[str, Any], da_b: DeepAccident, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    export_pages(folder=out, **arguments)
    other_arguments = arguments | {"scenarios": [da_b.scenario[1]]}
    export_pages(folder=out, **other_arguments)
    export_pages(folder=tmp_path / "fresh", **other_arguments)
    assert folder_contents(out) == folder_contents(tmp_path / "fresh")


def test_other_files_are_never_touched(arguments: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_pages(folder=out, **arguments)
    before = folder_contents(out)

    def export_again() -> None:
        export_pages(folder=out, **arguments)

    notes = out / "static" / "notes.txt"
    notes.write_text("mine")
    assert_raises((export_again, ConfigError, ("static/notes.txt", "which no export wrote")))
    assert notes.read_text() == "mine"
    notes.unlink()
    (out / "link").symlink_to(tmp_path)
    assert_raises((export_again, ConfigError, ("contains link", "which no export wrote")))
    (out / "link").unlink()
    assert folder_contents(out) == before


def test_impossible_folders_are_refused(arguments: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")

    def exporter(folder: Path | str) -> Callable[[], object]:
        return lambda: export_pages(folder=folder, **arguments)

    assert_raises(
        (exporter(tmp_path / "file"), ConfigError, ("is a file",)),
        (exporter(tmp_path / "file" / "below"), ConfigError, ("is a file",)),
        (exporter(tmp_path), ConfigError, ("contains file", "which no export wrote")),
        (exporter(""), ConfigError, ("an empty path",)),
    )
    assert folder_contents(tmp_path) == {"file": b"mine"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_export_leaves_nothing(
    arguments: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: type[BaseException],
) -> None:
    earlier_export = tmp_path / "kept"
    export_pages(folder=earlier_export, **arguments)
    before = folder_contents(tmp_path)

    def interrupt() -> dict[str, str]:
        assert len([*tmp_path.rglob("thumbnail.jpg")]) == 2  # something was written
        raise error

    monkeypatch.setattr(static_pages, "assets", interrupt)
    for folder in (earlier_export, tmp_path / "new"):
        with pytest.raises(error):
            export_pages(folder=folder, **arguments)
        assert folder_contents(tmp_path) == before
        assert [path.name for path in tmp_path.iterdir()] == ["kept"]
