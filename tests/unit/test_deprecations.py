"""Deprecated calls name both versions and the caller's line, and are removed in time."""

import ast
import re
import warnings
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from click import UsageError

import deepaccident_devkit
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli.export import mcap
from deepaccident_devkit.deprecations import DEPRECATED, warn_deprecated
from deepaccident_devkit.evaluation import DetectedBoxes
from deepaccident_devkit.evaluation.results import FORMAT_VERSION
from deepaccident_devkit.evaluation.runs.bundles import SUMMARY_VERSION
from deepaccident_devkit.motion import label_folder
from deepaccident_devkit.tables.manifest import SCHEMA_VERSION

PACKAGE = Path(deepaccident_devkit.__file__).parent
TOP = Path(__file__).parents[2]
PAGE = (TOP / "docs" / "stability.md").read_text(encoding="utf-8")


def old() -> None:
    warn_deprecated("old()", "new()", since="0.1", gone_in="0.2")


def test_the_warning_names_both_versions_and_the_callers_line() -> None:
    with pytest.warns(DeprecationWarning, match="old") as told:
        old()
    assert str(told[0].message) == "old() is deprecated since 0.1 and gone in 0.2; use new()"
    assert told[0].filename == __file__


def calls() -> Iterator[tuple[Path, ast.Call]]:
    """The calls of `warn_deprecated` in the package, and their files."""
    for path in PACKAGE.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "id", None) == "warn_deprecated":
                yield path, call


def named(call: ast.Call) -> dict[str, str]:
    return {one.arg: ast.literal_eval(one.value) for one in call.keywords if one.arg}


def test_nothing_is_deprecated_for_longer_than_it_says() -> None:
    here = version(deepaccident_devkit.__version__)
    found = list(calls())
    assert found
    for path, call in found:
        since, gone_in = named(call)["since"], named(call)["gone_in"]
        assert version(since) <= here < version(gone_in), f"{path}: remove what is deprecated"


def test_the_page_lists_what_warns_and_all_of_it_works(da: DeepAccident) -> None:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert da.samples("train") == da.training_samples("train")
        assert DetectedBoxes.from_arrays([[1, 2, 3]], [[4, 2, 1]], [0.0], [0.5]).boxes.frame == "lidar"
        assert da.find(visibility=None) == da.find(accident_visibility=None)
        assert da.find("junction=unknown") == da.find("road_type=unknown")
        with pytest.raises(UsageError, match="dataroot"):
            mcap.main(["--frames", "1..2"], standalone_mode=False)
    rows = re.findall(r"^\| (.*) \| (.*) \| ([\d.]+) \| ([\d.]+) \|$", PAGE.replace("`", ""), re.MULTILINE)
    warned = [re.fullmatch(DEPRECATED + "(.+)", str(each.message)) for each in told]
    assert [(what, since, gone_in, instead) for what, instead, since, gone_in in rows] == [
        each.groups() for each in warned if each
    ]
    names = {f"{name}.py" for name in ("sample_lists", "boxes", "fields", "options")}
    assert {path.name for path, _ in calls()} == names, "list it on the page, and call it above"


def test_the_page_has_the_versions_of_files_and_pythons() -> None:
    versions = re.findall(r"^\| [^|]+ \| (\d) \| ", PAGE, re.MULTILINE)
    assert versions == [
        str(each) for each in (SCHEMA_VERSION, label_folder.FORMAT_VERSION, FORMAT_VERSION, SUMMARY_VERSION)
    ]
    pythons = re.findall(r"Python :: (3\.\d+)", (TOP / "pyproject.toml").read_text(encoding="utf-8"))
    assert f"Python {', '.join(pythons[:-1])} and {pythons[-1]}" in PAGE


def test_every_package_of_the_reference_says_what_is_public() -> None:
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (TOP / "docs" / "api").glob("*.md"))
    need_torch = {"deepaccident_devkit.export.torch", "deepaccident_devkit.model"}
    names = set(re.findall(r"^\.\. automodule:: (\S+)", pages, re.MULTILINE)) - need_torch
    packages = [import_module(name) for name in ("deepaccident_devkit", *sorted(names))]
    silent = [each.__name__ for each in packages if hasattr(each, "__path__") and not hasattr(each, "__all__")]
    assert (len(packages) > 20, silent) == (True, [])


def version(text: str) -> tuple[int, ...]:
    """The first two numbers."""
    return tuple(int(part) for part in text.split(".")[:2])
