"""The data card's counts, texts and names, compared with the tables and the files, and as
mlcroissant reads them.
"""

import importlib.util
import itertools
import json
import os
import re
import shutil
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.command_calls import invoke_command, run_command

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.taxonomy import CHANNELS
from deepaccident_devkit.validation import data_card

LICENCE = "https://example.org/terms"


def strip_record_set_names(row: dict[str, Any]) -> dict[str, Any]:
    return {key.partition("/")[2]: value for key, value in row.items()}


def read_rows(card: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return the rows that a record set holds, by the names of its fields."""
    [record_set] = [entry for entry in card["recordSet"] if entry["name"] == name]
    fields = {field["@id"] for field in record_set["field"]}
    assert all(set(row) == fields for row in record_set["data"])
    return [strip_record_set_names(row) for row in record_set["data"]]


def read_fields(card: dict[str, Any], name: str) -> dict[str, Any]:
    [record_set] = [entry for entry in card["recordSet"] if entry["name"] == name]
    return {field["name"]: field for field in record_set["field"]}


def extract_value(field: dict[str, Any], text: str) -> str | None:
    """Return what a reader extracts for a field from a path or a line: the group of its pattern."""
    match = re.match(field["source"]["transform"]["regex"], text)
    return match and match[1]


def test_each_file_is_in_the_file_set_of_its_kind(both_layouts: DeepAccident) -> None:
    root = Path(both_layouts.dataroot)
    files = [path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()]
    card_files = [path for path in files if path[0] != "."]
    file_sets = data_card(both_layouts)["distribution"]
    patterns_by_set = {file_set["name"]: file_set["includes"] for file_set in file_sets}
    folder_kinds = {"label", "calib", "meta", *CHANNELS}
    for path in card_files:
        kinds = set()
        for name, patterns in patterns_by_set.items():
            if any(fnmatch(path, pattern) for pattern in patterns):
                kinds.add(name)
        kind = next((part for part in path.split("/")[:-1] if part in folder_kinds), "split_lists")
        assert kinds == ({"label", "label_lines"} if kind == "label" else {kind}), path

    matched_paths = set()
    for pattern in itertools.chain.from_iterable(patterns_by_set.values()):
        matched_paths.update(root.glob(pattern))  # here `*` does not match `/`
    assert {path.relative_to(root).as_posix() for path in matched_paths} == set(card_files)
    channels = {name for name in CHANNELS if f"/{name}/" in " ".join(files)}
    assert patterns_by_set.keys() & set(CHANNELS) == channels


def test_a_description_counts_the_files_of_a_partial_download(da_partial: DeepAccident) -> None:
    file_sets = data_card(da_partial)["distribution"]
    descriptions = {file_set["name"]: file_set["description"] for file_set in file_sets}
    assert "72 of 96 are here" in descriptions["lidar01"]
    assert "96 of 96 are here" in descriptions["Camera_Back"]


def test_a_labels_path_gives_its_sample_and_split(both_layouts: DeepAccident) -> None:
    root = Path(both_layouts.dataroot)
    fields = read_fields(data_card(both_layouts), "samples")
    is_layout_b = both_layouts.layout == "B"

    assert ("split" in fields) == is_layout_b
    for path in root.rglob("*/label/*/*.txt"):
        text = path.relative_to(root).as_posix()
        values = {name: extract_value(field, text) for name, field in fields.items()}
        names = [values[name] for name in ("scenario_type", "scenario", "agent", "frame")]
        sample = both_layouts.get("sample", "/".join(names))
        scenario = both_layouts.get("scenario", sample["scenario_token"])
        assert scenario["designed_accident"] == (values["accident"] == "accident")
        assert not is_layout_b or values["split"] == scenario["split"]


def test_the_licence_is_the_users(da: DeepAccident) -> None:
    card = data_card(da)
    assert "license" not in card
    assert "ask the authors of the dataset" in card["description"]
    licensed_card = data_card(da, licence=LICENCE)
    assert licensed_card["license"] == LICENCE
    assert "licence" not in licensed_card["description"]
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
    with pytest.raises(NotAvailableError, match="is not a DeepAccident release"):
        data_card(da_b)


def test_the_command_prints_only_the_card(da: DeepAccident) -> None:
    result = invoke_command("info", da.dataroot, "--croissant", "--licence", LICENCE)
    expected = json.loads(json.dumps(data_card(da, licence=LICENCE)))

    assert json.loads(result.stdout) == expected
    for options in (
        ("--croissant", "--json"),
        ("--croissant", "--where", "town=Town03"),
        ("--licence", LICENCE),
    ):
        assert "has no effect" in invoke_command("info", da.dataroot, *options, status=2).output


@pytest.fixture
def mlcroissant() -> ModuleType:
    is_required = os.environ.get("DEEPACCIDENT_REQUIRE_CROISSANT")
    if importlib.util.find_spec("mlcroissant") is None and not is_required:
        pytest.skip("no mlcroissant")
    return importlib.import_module("mlcroissant")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what mlcroissant itself calls
def test_mlcroissant_accepts_the_card_and_reads_its_records(
    mlcroissant: ModuleType, both_layouts: DeepAccident, tmp_path: Path
) -> None:
    """There is no error; without a licence, the only warning recommends one."""
    root = tmp_path / "release"
    shutil.copytree(both_layouts.dataroot, root)
    card_path = root / "croissant.json"
    for options, expected_warnings in (((), ["license"]), (("--licence", LICENCE), [])):
        text = run_command("info", root, "--croissant", *options).stdout
        card_path.write_text(text, encoding="utf-8")
        dataset = mlcroissant.Dataset(card_path)
        issues = dataset.metadata.ctx.issues
        assert issues.errors == set()
        assert re.findall(r"schema.org/(\w+)", " ".join(issues.warnings)) == expected_warnings

    card = data_card(both_layouts, licence=LICENCE)
    for name in ("splits", "counts"):
        rows = [strip_record_set_names(row) for row in dataset.records(name)]
        assert rows == [dict(sorted(row.items())) for row in read_rows(card, name)]

    tokens = []
    for record in dataset.records("samples"):
        sample = strip_record_set_names(record)
        names = [sample[name] for name in ("scenario_type", "scenario", "agent")]
        names = [name.decode() if isinstance(name, bytes) else name for name in names]
        tokens.append("/".join([*names, f"{sample['frame']:03d}"]))
    assert sorted(tokens) == sorted(sample["token"] for sample in both_layouts.sample)
