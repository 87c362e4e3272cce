"""The section on what stays has the versions there are, and packages say what is public."""

import re
from importlib import import_module
from pathlib import Path

import pytest
from scripts import loaded_script

from deepaccident_devkit.evaluation.results import FORMAT_VERSION
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_VERSION
from deepaccident_devkit.motion import label_folder
from deepaccident_devkit.tables.index import SCHEMA_VERSION

TOP = Path(__file__).parents[2]
PAGE = (TOP / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## What stays")[1]


def test_it_has_the_versions_of_files_and_pythons() -> None:
    versions = re.findall(r"^\| [^|]+ \| (\d) \| ", PAGE, re.MULTILINE)
    assert versions == [
        str(each) for each in (SCHEMA_VERSION, label_folder.FORMAT_VERSION, FORMAT_VERSION, SUMMARY_VERSION)
    ]
    pythons = re.findall(r"Python :: (3\.\d+)", (TOP / "pyproject.toml").read_text(encoding="utf-8"))
    assert f"Python {', '.join(pythons[:-1])} and {pythons[-1]}" in " ".join(PAGE.split())


def test_every_package_of_the_reference_says_what_is_public() -> None:
    listed = {name for names in loaded_script("docs/conf.py").REFERENCE.values() for name in names}
    names = [f".{name}" for name in listed - {"export.torch", "model"} if name.rpartition(".")[2].islower()]
    packages = [import_module(name, "deepaccident_devkit") for name in names]
    assert len(packages) > 20
    assert [each for each in packages if hasattr(each, "__path__") and not hasattr(each, "__all__")] == []


@pytest.mark.parametrize("task", ["accident", "detection", "motion", "warning"])
def test_tasks_import_by_their_old_paths(task: str) -> None:
    old, new = (import_module(f"deepaccident_devkit.evaluation.{place}{task}") for place in ("metrics.", ""))
    assert [getattr(old, name) for name in new.__all__] == [getattr(new, name) for name in new.__all__]


@pytest.mark.parametrize(
    ("place", "name", "home"),
    [
        ("render.safety", "save_safety_report", "safety.page"),
        ("render", "render_town_map", "maps.pictures"),
        ("evaluation.warning", "PreventedResult", "safety.prevention_result"),
        ("evaluation.runs", "with_prevented", "safety.prevention"),
    ],
)
def test_what_rooms_have_now_imports_from_the_core(place: str, name: str, home: str) -> None:
    core, room = (import_module(f"deepaccident_devkit.{each}") for each in (place, home))
    assert getattr(core, name) is getattr(room, name)
    assert name in dir(core)
    with pytest.raises(AttributeError, match=f"module 'deepaccident_devkit.{place}' has no attribute 'nothing'"):
        core.nothing  # noqa: B018 - asked for alone
