"""The documentation site: what it lists, and how docstrings get onto it. `.ci/run` builds it,
warnings as errors.
"""

import pkgutil
import re
from importlib import import_module
from pathlib import Path

from scripts import loaded_script

import deepaccident_devkit

DOCS = Path(__file__).parents[1] / "docs"
NOT_FOR_USERS = {"cli", "dataset", "deepaccident", "tables"}
"""Command line, base of the facade, and what only the devkit itself calls."""
CONFIGURATION = loaded_script("docs/conf.py")


def documented() -> set[str]:
    return {name for listed in CONFIGURATION.REFERENCE.values() for name in listed}


def test_every_public_module_is_on_an_api_page() -> None:
    names = {module.name for module in pkgutil.iter_modules(deepaccident_devkit.__path__)}
    public = {name for name in names if not name.startswith("_")} - NOT_FOR_USERS
    assert public - {name.partition(".")[0] for name in documented()} == set()


def test_every_package_of_the_evaluation_is_on_an_api_page() -> None:
    evaluation = import_module("deepaccident_devkit.evaluation")
    packages = [
        each.name
        for each in pkgutil.walk_packages(evaluation.__path__, f"{evaluation.__name__}.")
        if each.ispkg
    ]
    public = {
        name.partition(".")[2] for name in packages if hasattr(import_module(name), "__all__")
    }
    assert {"evaluation.accident", "evaluation.runs"} <= public
    assert public - documented() == set()


def test_every_page_is_listed() -> None:
    """The build would tell, too, but takes half a minute."""
    listed = set(
        re.findall(r"^[\w/.]+$", (DOCS / "index.md").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert {path.stem for path in DOCS.glob("*.md")} - listed == {"index"}


def test_the_reference_lists_each_name_once(tmp_path: Path) -> None:
    CONFIGURATION.write_reference(tmp_path)
    pages = [path.read_text(encoding="utf-8") for path in tmp_path.glob("*.md")]
    names = [
        name
        for page in pages
        for line in re.findall(":members: (.+)", page)
        for name in line.split(", ")
    ]
    assert len(names) == len(set(names)) > 300
    index = (tmp_path / "index.md").read_text(encoding="utf-8")
    assert {path.stem for path in tmp_path.glob("*.md")} - set(
        re.findall(r"^\w+$", index, re.MULTILINE)
    ) == {"index"}
