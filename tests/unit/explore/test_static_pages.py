"""Pages as files: they say what served pages say, need nothing else, and are there as a whole or not at all."""

import re
import shutil
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urljoin

import pytest
from damaged_releases import damaged_release
from evaluation_runs import stored_run
from replay_page import accident, data_of, normal
from shown_page import Shown, shown

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, NotAvailableError, TokenError
from deepaccident_devkit.evaluation.results import read_results
from deepaccident_devkit.evaluation.runs import save_run
from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup
from deepaccident_devkit.explore import Explorer, export_pages, static_pages
from deepaccident_devkit.explore.pages.scenario import PARTS, part_html
from deepaccident_devkit.render.replay import render_replay

pytestmark = pytest.mark.slow

SVG = "http://www.w3.org/2000/svg"
"""A name, which no browser opens."""


class Made(NamedTuple):
    """An export with two bundles and results without one, and what it was made from."""

    index: Path
    bundle: Path
    motion: Path

    def page(self, token: str) -> Shown:
        return shown(self.index.parent / token / "index.html")

    def replay(self, token: str) -> dict[str, Any]:
        return data_of(self.index.parent / token / "replay.html")


@pytest.fixture(scope="module")
def made(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("made")
    run, _ = stored_run(da_motion, EvaluationSetup(task="accident", protocol="boxes"), folder / "first.json")
    bundle = save_run(run, folder / "first", include_results=True)
    stored_run(da_motion, EvaluationSetup(task="motion"), folder / "maps")
    detection, _ = stored_run(da_motion, EvaluationSetup(task="detection"), folder / "boxes.json")
    boxes = save_run(detection, folder / "boxes")
    index = export_pages(
        da_motion,
        folder / "out",
        bundles=[boxes, bundle],
        results=[folder / "boxes.json", folder / "maps"],
        workers=1,
    )
    return Made(index, bundle, folder / "maps")


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_is_written(made: Made, da_motion: DeepAccident) -> None:
    tokens = [scenario["token"] for scenario in da_motion.scenario]
    of_scenarios = [f"{token}/{name}" for token in tokens for name in ("index.html", "replay.html", "thumbnail.jpg")]
    found = contents(made.index.parent)
    static = {"explore.css", "keys.js", "pages.css", "sorting.js"}
    assert found.keys() == {"index.html", ".deepaccident_pages", *of_scenarios, *(f"static/{each}" for each in static)}
    assert [path.name for path in made.index.parent.parent.glob(".*")] == []


def test_all_links_lead_to_files(made: Made) -> None:
    root = made.index.parent
    loaded = set()
    for page in root.rglob("index.html"):
        told = shown(page)
        for address in [*(address for address, _ in told.links), *told.loads]:
            if not address.startswith(("#", "data:")):
                target = Path(unquote(urljoin(page.as_uri(), address)).removeprefix("file://"))
                assert target.is_file(), address
                assert target.is_relative_to(root)
                assert not address.startswith("/")
                loaded.add(target)
    assert loaded == {path for path in root.rglob("*") if path.is_file() and path.name != ".deepaccident_pages"}


def test_nothing_needs_a_network_or_tells_where_the_release_lies(made: Made, da_motion: DeepAccident) -> None:
    for name, content in contents(made.index.parent).items():
        text = content.decode(errors="replace").replace(SVG, "")
        assert not re.search(r"https?:|//[a-z]+\.", text), name
        assert str(da_motion.dataroot) not in text, name
        assert str(made.index.parent) not in text, name


def test_a_policy_forbids_what_is_not_a_file_of_it(made: Made) -> None:
    for page in made.index.parent.rglob("index.html"):
        told = shown(page)
        (policy,) = [each["content"] for each in told.all("meta") if "http-equiv" in each]
        assert policy.startswith("default-src 'none'; script-src 'self' file:;")
        assert not re.search("unsafe|connect-src", policy)
        head = [tag for tag, _ in told.tags]
        assert head.index("meta") < head.index("link")
        for script in told.all("script"):
            assert script["src"]
            assert script.get("type", "") != "module"  # which no browser loads from a disk


def test_the_list_has_the_scenarios_and_their_values(made: Made, da_motion: DeepAccident) -> None:
    told = shown(made.index)
    assert "2 scenarios of DeepAccident v1" in told.text
    assert "da.find()" in told.text
    assert "deepaccident explore DATAROOT --out DIR" in told.text
    explorer = Explorer(da_motion)
    explorer.scenarios.begin()
    assert explorer.jobs.wait(60)
    rows = told.table("scenario")
    for row, record in zip(rows, da_motion.scenario, strict=True):
        place = explorer.scenarios.row_of[record["token"]]
        assert row[0] == record["token"]
        assert row[2:6] == [record["town"], f"{record['weather']}, {record['time_of_day']}", "train", "35"]
        visibility, lead = (explorer.scenarios.values(name)[place] for name in ("accident_visibility", "lead"))
        assert row[6] == (visibility or "–")
        assert row[7] == ("–" if lead is None else f"{lead:.1f}")
    explorer.jobs.end()
    keys = [each["data-key"] for each in told.all("td") if "data-key" in each]
    assert len(keys) == 2 * 4
    assert all(not key or float(key) >= 0 for key in keys)


@pytest.mark.parametrize("which", [accident, normal])
def test_a_page_has_all_parts(made: Made, da_motion: DeepAccident, which: Any) -> None:
    token = which(da_motion)
    page, explorer = made.page(token), Explorer(da_motion)
    text = " ".join(page.text.split())
    for name, title in PARTS.items():
        served = Shown(part_html(explorer, token, name, "../../../"))
        assert title in page.text
        if name != "findings":
            assert " ".join(served.text.split()) in text, name
    assert "None: the labels, calib and meta files agree." in text
    assert "What was not downloaded" not in text  # there is no page of it here
    assert page.all("button") == []
    for name, value in made.replay(token)["facts"]:
        assert f"{name}{value}" in page.text
    assert [each["src"] for each in page.all("iframe")] == ["replay.html"]
    assert page.address_of("Its twin").startswith("../../type1_subtype1_")


def test_pages_lead_to_their_neighbours(made: Made, da_motion: DeepAccident) -> None:
    first, last = (scenario["token"] for scenario in da_motion.scenario)
    assert made.page(first).address_of("next →") == f"../../{last}/index.html"
    assert made.page(last).address_of("← previous") == f"../../{first}/index.html"
    assert "previous" not in made.page(first).text
    assert "next" not in made.page(last).text


def test_a_replay_shows_the_first_model_that_can(made: Made, da_motion: DeepAccident, tmp_path: Path) -> None:
    """`boxes` has detections, which no replay shows; `first` tells of the accident alone, `maps` of it too."""
    collided = accident(da_motion)
    alone = render_replay(
        da_motion, collided, tmp_path / "a.html", prediction=read_results(made.bundle / "results" / "first.json")
    )
    assert (made.index.parent / collided / "replay.html").read_bytes() == alone.read_bytes()
    assert "The replay shows predictions of first." in made.page(collided).text
    without = render_replay(da_motion, normal(da_motion), tmp_path / "b.html")
    assert (made.index.parent / normal(da_motion) / "replay.html").read_bytes() == without.read_bytes()
    assert "predictions of" not in made.page(normal(da_motion)).text


def test_the_same_call_gives_the_same_bytes(made: Made, da_motion: DeepAccident, tmp_path: Path) -> None:
    folder = made.bundle.parent
    again = export_pages(
        da_motion,
        tmp_path / "another name",
        bundles=[folder / "boxes", folder / "first"],
        results=[folder / "boxes.json", folder / "maps"],
        workers=2,
    )
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
    assert "da.find('collision=true', 'length>=1')" in shown(index).text
    assert "--where collision=true --where 'length>=1' --out DIR" in shown(index).text
    chosen = [da_b.scenario[4], tokens[1], tokens[4]]
    index = export_pages(da_b, tmp_path / "b", scenarios=chosen, workers=1)
    assert listed(index) == [tokens[4], tokens[1]]
    found = re.search(r"da\.find\('(.*?)'\)", shown(index).text)
    assert found is not None
    assert {each["token"] for each in da_b.find(found[1])} == {tokens[4], tokens[1]}
    index = export_pages(da_b, tmp_path / "c", scenarios=tokens[::-1], where=["collision=true"], workers=1)
    assert listed(index) == wanted[::-1]
    assert "There is no replay: not in this test" in shown(tmp_path / "c" / wanted[0] / "index.html").text


@pytest.mark.parametrize(
    ("chosen", "error", "sentence"),
    [
        ({}, ConfigError, "6 scenarios match, and at most 3 are exported; narrow --where"),
        ({"where": ["length>=1000"]}, NotAvailableError, "no scenario matches"),
        ({"scenarios": []}, NotAvailableError, "no scenario matches"),
        ({"scenarios": ["no such"]}, TokenError, "no such"),
        ({"where": ["collision=true"], "workers": 0}, ChoiceError, "workers"),
    ],
)
def test_what_cannot_be_exported(
    da_b: DeepAccident,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    chosen: dict[str, Any],
    error: type[Exception],
    sentence: str,
) -> None:
    monkeypatch.setattr(static_pages, "MOST", 3)
    with pytest.raises(error, match=sentence):
        export_pages(da_b, tmp_path / "out", **chosen)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.usefixtures("_quickly")
def test_hostile_names_are_text(own_release: Path, tmp_path: Path) -> None:
    first = DeepAccident("v1", own_release, verbose=False).scenario[0]
    hostile = "<img src=x onerror=alert(1)>'\"&?#%41 .."
    for path in sorted(own_release.rglob(f"*{first['name']}*"), reverse=True):
        path.rename(path.with_name(path.name.replace("Town", f"{hostile}Town")))
    dataset = DeepAccident("v1", own_release, verbose=False)
    token = next(scenario["token"] for scenario in dataset.scenario if hostile in scenario["name"])
    index = export_pages(dataset, tmp_path / "out", scenarios=[token], workers=1)
    page = shown(index)
    assert [each["src"] for each in page.all("img")] == [address for address in page.loads if address.endswith("jpg")]
    assert page.table("scenario")[0][0] == token
    (folder,) = (tmp_path / "out").glob("type*/*")
    assert re.fullmatch(r"[A-Za-z0-9_.-]+", folder.name)
    own = shown(folder / "index.html")
    assert own.all("img") == []
    assert token in own.text
    assert (index.parent / unquote(page.address_of(token))).is_file()


def test_a_damaged_release(own_release: Path, tmp_path: Path) -> None:
    damaged = damaged_release(own_release)
    index = export_pages(damaged.dataset, tmp_path / "out", workers=1)
    assert listed(index) == [scenario["token"] for scenario in damaged.dataset.scenario]
    assert damaged.broken not in listed(index)
    unlabelled = shown(tmp_path / "out" / damaged.without_labels / "index.html")
    assert "The scenario" in unlabelled.text
    assert unlabelled.all("iframe")
    told = shown(tmp_path / "out" / damaged.without_meta / "index.html")
    assert "meta-missing" in told.text
    for name, content in contents(tmp_path / "out").items():
        assert str(own_release) not in content.decode(errors="replace"), name
    for page in (tmp_path / "out").rglob("index.html"):
        assert str(own_release) not in shown(page).text  # without the places where names may be broken


def test_images_that_cannot_be_read_are_told(da: DeepAccident, tmp_path: Path) -> None:
    root = tmp_path / "release"
    shutil.copytree(da.dataroot, root, ignore=shutil.ignore_patterns(".deepaccident", "lidar01", "Camera_Back*"))
    dataset = DeepAccident("v1", root, verbose=False)
    token = accident(dataset)
    whole = export_pages(dataset, tmp_path / "whole", scenarios=[token], workers=1)
    assert (whole.parent / token / "replay.html").stat().st_size > 100_000
    for path in root.rglob("Camera_Front*/*/*.jpg"):
        path.write_bytes(b"no picture")
    index = export_pages(dataset, tmp_path / "out", scenarios=[token], workers=1)
    page = shown(index.parent / token / "index.html")
    assert "There is no replay: " in page.text
    assert str(root) not in page.text
    assert page.all("iframe") == []
    assert not (index.parent / token / "replay.html").exists()


# the folder


@pytest.fixture
def one(da_b: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments for an export of a scenario without a replay."""
    monkeypatch.setattr(static_pages, "tried_replay", lambda *_, **__: "not in this test")
    return {"dataset": da_b, "scenarios": [da_b.scenario[0]], "workers": 1}


def test_an_earlier_export_is_replaced(one: dict[str, Any], da_b: DeepAccident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    export_pages(folder=out, **one)
    other = one | {"scenarios": [da_b.scenario[1]]}
    export_pages(folder=out, **other)
    export_pages(folder=tmp_path / "fresh", **other)
    assert contents(out) == contents(tmp_path / "fresh")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "fresh"}


def test_other_files_are_never_touched(one: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_pages(folder=out, **one)
    (out / "static" / "notes.txt").write_text("mine")
    before = contents(out)
    with pytest.raises(ConfigError, match=r"holds static/notes\.txt, which no export wrote"):
        export_pages(folder=out, **one)
    (out / "static" / "notes.txt").unlink()
    (out / "link").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="holds link, which no export wrote"):
        export_pages(folder=out, **one)
    (out / "link").unlink()
    (out / ".deepaccident_pages").write_text("index.html\n")
    with pytest.raises(ConfigError, match="which no export wrote"):
        export_pages(folder=out, **one)
    del before[".deepaccident_pages"], before["static/notes.txt"]
    after = contents(out)
    del after[".deepaccident_pages"]
    assert after == before


def test_folders_that_cannot_be(one: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for folder, said in {
        tmp_path / "file": "is a file",
        tmp_path / "file" / "below": "is a file",
        tmp_path: "holds file, which no export wrote",
        "": "an empty path",
    }.items():
        with pytest.raises(ConfigError, match=said):
            export_pages(folder=folder, **one)
    assert contents(tmp_path) == {"file": b"mine"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_an_interrupted_export_leaves_nothing(
    one: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    kept = tmp_path / "kept"
    export_pages(folder=kept, **one)
    before = contents(tmp_path)
    assets = static_pages.assets

    def interrupted() -> dict[str, str]:
        assert [*tmp_path.rglob("thumbnail.jpg")] != [kept]  # something was written
        raise error

    monkeypatch.setattr(static_pages, "assets", interrupted)
    for folder in (kept, tmp_path / "new"):
        with pytest.raises(error):
            export_pages(folder=folder, **one)
        assert contents(tmp_path) == before
        assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    monkeypatch.setattr(static_pages, "assets", assets)


def test_a_link_to_a_folder_stays_one(one: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    index = export_pages(folder=tmp_path / "link", **one)
    assert index == tmp_path.resolve() / "real" / "index.html"
    assert (tmp_path / "link").is_symlink()
