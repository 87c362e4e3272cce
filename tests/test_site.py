"""The documentation site lists every page and every public name once.

`.ci/run` builds it, with warnings as errors.
"""

import pkgutil
import re
from importlib import import_module
from pathlib import Path

from support.repository_scripts import load_script

import deepaccident_devkit

DOCS = Path(__file__).parents[1] / "docs"
NOT_FOR_USERS = {"cli", "dataset", "deepaccident", "tables"}
"""The command line, the base of the facade, and modules that only the devkit itself calls."""
CONFIGURATION = load_script("docs/conf.py")


def documented_names() -> set[str]:
    return set().union(*CONFIGURATION.REFERENCE.values())


def test_every_public_module_is_on_an_api_page() -> None:
    names = {module.name for module in pkgutil.iter_modules(deepaccident_devkit.__path__)}
    public_names = {name for name in names if not name.startswith("_")} - NOT_FOR_USERS
    documented_modules = {name.partition(".")[0] for name in documented_names()}
    assert public_names - documented_modules == set()


def test_every_package_of_the_evaluation_is_on_an_api_page() -> None:
    evaluation = import_module("deepaccident_devkit.evaluation")
    modules = pkgutil.walk_packages(evaluation.__path__, f"{evaluation.__name__}.")
    packages = [module.name for module in modules if module.ispkg]
    public_names = {
        name.partition(".")[2] for name in packages if hasattr(import_module(name), "__all__")
    }
    assert {"evaluation.accident", "evaluation.runs"} <= public_names
    assert public_names - documented_names() == set()


def test_every_page_is_listed() -> None:
    """The build would find a missing page too, but takes half a minute."""
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    listed_pages = set(re.findall(r"^[\w/.]+$", index, re.MULTILINE))
    assert {path.stem for path in DOCS.glob("*.md")} - listed_pages == {"index"}


def test_the_reference_lists_each_name_once(tmp_path: Path) -> None:
    CONFIGURATION.write_reference(tmp_path)
    pages = {path.stem: path.read_text(encoding="utf-8") for path in tmp_path.glob("*.md")}
    lines = re.findall(":members: (.+)", "\n".join(pages.values()))
    names = ", ".join(lines).split(", ")
    assert len(names) == len(set(names)) > 300
    listed_pages = set(re.findall(r"^\w+$", pages["index"], re.MULTILINE))
    assert pages.keys() - listed_pages == {"index"}
