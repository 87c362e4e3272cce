"""docs/public_names.json lists what is public; docs/stability.md has the current versions."""

import ast
import json
import re
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from support.repository_scripts import load_script

from deepaccident_devkit.evaluation.results import FORMAT_VERSION
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_VERSION
from deepaccident_devkit.motion import label_folder
from deepaccident_devkit.tables.index import SCHEMA_VERSION

TOP = Path(__file__).parents[2]
PAGE = (TOP / "docs" / "stability.md").read_text(encoding="utf-8")
CHANGED = """what is public is no longer what docs/public_names.json says:

{}

Was that wanted? docs/stability.md says which version may do it. Write it into CHANGELOG.md, with what to use instead,
and run: python docs/make_public_names.py"""  # noqa: E501
OLD = {
    "rooms": {
        "geometry": {
            "Box": "class ()",
            "area": "(box: Box, scale: float=1.0) -> float",
            "gone": ": int",
        }
    },
    "commands": {"deepaccident info": "DATAROOT --json"},
    "daily": {
        "geometry.area": {"page": "docs/reading.md", "is": "(box: Box, scale: float=1.0) -> float"}
    },
}


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("docs/make_public_names.py")


@pytest.fixture(scope="module")
def listed(script: ModuleType) -> dict[str, Any]:
    return script.listed()


def test_what_is_public_is_what_the_list_says(script: ModuleType, listed: dict[str, Any]) -> None:
    changes = script.differences(json.loads(script.FILE.read_text(encoding="utf-8")), listed)
    assert changes == [], CHANGED.format("\n".join(changes))
    assert script.FILE.read_text(encoding="utf-8") == script.as_json(listed), (
        "run: python docs/make_public_names.py"
    )


def test_a_change_is_named(script: ModuleType) -> None:
    new = json.loads(
        json.dumps(OLD).replace("scale: float=1.0", "scale: float=2.0").replace("gone", "came")
    )
    new["commands"]["deepaccident info"] += " --out"
    new["daily"]["geometry.area"]["page"] = "docs/safety.md"
    old_area = "(box: Box, scale: float=1.0) -> float"
    new_area = "(box: Box, scale: float=2.0) -> float"
    assert script.differences(OLD, OLD) == []
    assert script.differences(OLD, new) == [
        "removed: geometry: gone",
        "added: geometry: came",
        "changed: deepaccident info\n    was DATAROOT --json\n    is  DATAROOT --json --out",
        (
            "changed: geometry.area, of daily use\n    was in docs/reading.md\n  "
            "  is  in docs/safety.md"
        ),
        f"changed: geometry: area\n    was {old_area}\n    is  {new_area}",
    ]


def test_no_public_name_begins_with_an_underscore(script: ModuleType) -> None:
    names = [name for public in script.public_modules().values() for name in public]
    assert len(names) > 500
    assert [name for name in names if name.startswith("_")] == ["__version__"]


def test_code_of_pages_imports_only_public_names(script: ModuleType) -> None:
    public_names = set()
    for module, names in script.public_modules().items():
        public_names |= {(module, name) for name in names}
        if "." in module:
            public_names.add(tuple(module.rsplit(".", 1)))

    pages = [TOP / "README.md", *(TOP / "docs").glob("*.md"), *(TOP / "schema").rglob("*.md")]
    imports = [
        (node.module, alias.name)
        for page in pages
        for node in script.code_of(page)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(script.PACKAGE)
        for alias in node.names
    ]
    assert len(imports) > 60
    assert set(imports) <= public_names


def test_it_has_the_versions_of_files() -> None:
    versions = (
        SCHEMA_VERSION,
        label_folder.LABEL_FORMAT_VERSION,
        FORMAT_VERSION,
        SUMMARY_VERSION,
    )
    page_versions = re.findall(r"^\| [^|]+ \| (\d) \| ", PAGE, re.MULTILINE)
    assert page_versions == list(map(str, versions))


def test_every_package_of_the_reference_says_what_is_public() -> None:
    reference = load_script("docs/conf.py").REFERENCE
    names = {name for section in reference.values() for name in section}
    names -= {"training.torch", "plugins.model"}
    module_names = [f".{name}" for name in names if name.rpartition(".")[2].islower()]
    modules = [import_module(name, "deepaccident_devkit") for name in module_names]
    assert len(modules) > 20
    for module in modules:
        if hasattr(module, "__path__"):
            assert hasattr(module, "__all__"), module
