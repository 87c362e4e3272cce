"""The data card: what it counts, says and names, beside the tables and the files; and what
mlcroissant makes of it.
"""

import importlib.util
import json
import os
import re
import shutil
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from verbs import called, ran

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.taxonomy import CHANNELS
from deepaccident_devkit.validation import data_card

LICENCE = "https://example.org/terms"


def rows_of(card: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The rows that a record set holds, by the names of its fields."""
    [found] = [each for each in card["recordSet"] if each["name"] == name]
    fields = {field["@id"] for field in found["field"]}
    assert all(set(row) == fields for row in found["data"])
    return [{key.partition("/")[2]: value for key, value in row.items()} for row in found["data"]]


def fields_of(card: dict[str, Any], name: str) -> dict[str, Any]:
    [found] = [each for each in card["recordSet"] if each["name"] == name]
    return {field["name"]: field for field in found["field"]}


def found_by(field: dict[str, Any], text: str) -> str | None:
    """What a reader finds for a field in a path or a line: the group of its pattern."""
    matched = re.match(field["source"]["transform"]["regex"], text)
    return matched and matched[1]


def test_each_file_is_in_the_file_set_of_its_kind(both_layouts: DeepAccident) -> None:
    root = Path(both_layouts.dataroot)
    paths = [path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()]
    sets = {each["name"]: each["includes"] for each in data_card(both_layouts)["distribution"]}
    for path in (path for path in paths if path[0] != "."):
        kinds = {
            name for name, includes in sets.items() if any(fnmatch(path, each) for each in includes)
        }
        by_hand = next(
            (
                part
                for part in path.split("/")[:-1]
                if part in ("label", "calib", "meta", *CHANNELS)
            ),
            None,
        )
        labels = {"label", "label_lines"}
        assert kinds == (labels if by_hand == "label" else {by_hand or "split_lists"}), path
    globbed = {
        path for includes in sets.values() for each in includes for path in root.glob(each)
    }  # `*` without `/`
    assert {path.relative_to(root).as_posix() for path in globbed} == {
        path for path in paths if path[0] != "."
    }
    assert {name for name in sets if name in CHANNELS} == {
        name for name in CHANNELS if f"/{name}/" in " ".join(paths)
    }


def test_what_a_partial_download_lacks_is_told(da_partial: DeepAccident) -> None:
    texts = {each["name"]: each["description"] for each in data_card(da_partial)["distribution"]}
    assert "72 of 96 are here" in texts["lidar01"]
    assert "96 of 96 are here" in texts["Camera_Back"]


def test_paths_say_whose_a_label_is(both_layouts: DeepAccident) -> None:
    fields, root = fields_of(data_card(both_layouts), "samples"), Path(both_layouts.dataroot)
    layout_b = both_layouts.layout == "B"
    assert ("split" in fields) == layout_b
    for path in root.rglob("*/label/*/*.txt"):
        told = {
            name: found_by(field, path.relative_to(root).as_posix())
            for name, field in fields.items()
        }
        sample = both_layouts.get(
            "sample", f"{told['scenario_type']}/{told['scenario']}/{told['agent']}/{told['frame']}"
        )
        scenario = both_layouts.get("scenario", sample["scenario_token"])
        assert scenario["designed_accident"] == (told["accident"] == "accident")
        assert not layout_b or told["split"] == scenario["split"]


def test_the_licence_is_the_users(da: DeepAccident) -> None:
    without, stated = data_card(da), data_card(da, licence=LICENCE)
    assert ("license" in without, "ask the dataset's authors" in without["description"]) == (
        False,
        True,
    )
    assert (stated["license"], "licence" in stated["description"]) == (LICENCE, False)
    with pytest.raises(ChoiceError, match="licence: expected a text such as a URL, found ' '"):
        data_card(da, licence=" ")


def test_the_same_release_elsewhere_has_the_same_card(
    da_b: DeepAccident, own_release: Path
) -> None:
    moved = json.dumps(data_card(DeepAccident(dataroot=own_release, verbose=False)))
    assert moved == json.dumps(data_card(da_b))
    assert str(da_b.dataroot) not in moved


def test_other_datasets_have_no_card(da_b: DeepAccident, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(da_b, "layout", "nuScenes")
    with pytest.raises(NotAvailableError, match="is no release of DeepAccident"):
        data_card(da_b)


def test_the_command_prints_the_card_alone(da: DeepAccident) -> None:
    printed = called("info", da.dataroot, "--croissant", "--licence", LICENCE).stdout
    assert json.loads(printed) == json.loads(json.dumps(data_card(da, licence=LICENCE)))
    for words in (
        ("--croissant", "--json"),
        ("--croissant", "--where", "town=Town03"),
        ("--licence", LICENCE),
    ):
        assert "changes nothing" in called("info", da.dataroot, *words, status=2).output


@pytest.fixture
def mlcroissant() -> ModuleType:
    if importlib.util.find_spec("mlcroissant") is None and not os.environ.get(
        "DEEPACCIDENT_REQUIRE_CROISSANT"
    ):
        pytest.skip("no mlcroissant")
    return importlib.import_module("mlcroissant")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what mlcroissant itself calls
def test_mlcroissant_takes_the_card_and_reads_what_it_can(
    mlcroissant: ModuleType, both_layouts: DeepAccident, tmp_path: Path
) -> None:
    """No error; without a licence one warning, that it is recommended."""
    root = tmp_path / "release"
    shutil.copytree(both_layouts.dataroot, root)
    beside = root / "croissant.json"
    for options, warned in (((), ["license"]), (("--licence", LICENCE), [])):
        beside.write_text(ran("info", root, "--croissant", *options).stdout, encoding="utf-8")
        read = mlcroissant.Dataset(beside)
        issues = read.metadata.ctx.issues
        assert (issues.errors, re.findall(r"schema.org/(\w+)", " ".join(issues.warnings))) == (
            set(),
            warned,
        )
    card = data_card(both_layouts, licence=LICENCE)
    for name in ("splits", "counts"):
        rows = [
            {key.partition("/")[2]: value for key, value in row.items()}
            for row in read.records(name)
        ]
        assert rows == [dict(sorted(row.items())) for row in rows_of(card, name)]
    samples = [
        {
            key.partition("/")[2]: each.decode() if isinstance(each, bytes) else each
            for key, each in row.items()
        }
        for row in read.records("samples")
    ]
    assert {
        f"{each['scenario_type']}/{each['scenario']}/{each['agent']}/{each['frame']:03d}"
        for each in samples
    } == {each["token"] for each in both_layouts.sample}
    assert len(samples) == len(both_layouts.sample)
