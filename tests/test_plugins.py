"""The core without each plug-in: it imports, its commands run, its tests pass, and it names what is
missing.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import deepaccident_devkit
from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.support import plugins
from deepaccident_devkit.support.plugins import offers, own_plugins

TESTS = Path(__file__).parent
PACKAGE = Path(deepaccident_devkit.__file__).parent
OWN = ("audit", "baselines", "explore", "model", "nuscenes", "safety", "study", "synth")
MODULES_OF_THE_CORE = 200
NEEDED = {
    "audit": (),
    "baselines": ("verb('demo')", "verb('study')"),
    "explore": (),
    "model": ("verb('predict', str(da.dataroot), str(da.dataroot), '--out', 'predicted')",),
    "nuscenes": (),
    "safety": ("verb('explore')", "list(further_results({'prevented': {'interval_notes': []}}))"),
    "study": (),
    "synth": ("verb('study')",),
}
"""Plug-in → what else cannot be had without it, in terms of `PROBE`."""
WORKS = (
    "verb('--help')",
    "verb('info', str(da.dataroot))",
    "verb('info', '--fields')",
    "verb('evaluate', '--help')",
    "verb('export', '--help')",
    "verb('render', '--help')",
    "verb('validate', str(da.dataroot))",
    "da.find('closing_speed>=0', town='Town03')",
    "da.find(min_ttc='..1')",
    "da.interactions(da.scenario[0])",
    "da.describe(da.scenario[0])",
    "dataset_statistics(da, interactions=True)",
    "da.render_bev(da.sample[0], layers=('bev', 'boxes'))",
    "dataset_statistics(da)",
)
PROBE = """
import importlib, json, pkgutil, sys, warnings
from click.testing import CliRunner
import deepaccident_devkit
from deepaccident_devkit import DeepAccident, render
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError, MissingPluginError
from deepaccident_devkit.evaluation.runs.further import further_results
from deepaccident_devkit.statistics import dataset_statistics

root, works, asked = json.loads(sys.argv[1])
names = [each.name for each in pkgutil.walk_packages(
    deepaccident_devkit.__path__, "deepaccident_devkit.", onerror=lambda name: None)]
core = [each for each in names if not each.startswith("deepaccident_devkit.plugins.") and not each.endswith("__main__")]
for name in core:
    try:
        importlib.import_module(name)
    except MissingExtraError:
        pass
    except ModuleNotFoundError as error:  # below a package that an extra brings
        assert error.name == "torch", error

def verb(*words):
    done = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert done.exit_code < 2, done.output

da = DeepAccident("v1", root, verbose=False)
for expression in works:
    eval(expression)
named = {}
for expression in asked:
    try:
        eval(expression)
    except MissingPluginError as error:
        named[expression] = str(error)
print(json.dumps([deepaccident_devkit.__file__, len(core), named]))
"""  # noqa: E501


def copy_without(folder: Path, *without: str) -> Path:
    """Copy the package into a folder, without some plug-ins; an editable installation does not
    provide them either.
    """
    shutil.copytree(PACKAGE, folder / PACKAGE.name)
    for name in without:
        shutil.rmtree(folder / PACKAGE.name / "plugins" / name)
    (folder / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [each for each in sys.meta_path if "
        "'__editable__' not in str(each)]\n"
    )
    return folder


def run_in(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A run of Python on the copy of the package in a folder."""
    paths = os.pathsep.join([str(folder), str(TESTS)])
    variables = {**os.environ, "PYTHONPATH": paths, "MPLBACKEND": "Agg", **environment}
    how: dict[str, Any] = {
        "cwd": folder,
        "env": variables,
        "capture_output": True,
        "text": True,
        "timeout": 1800,
    }
    return subprocess.run([sys.executable, *words], check=False, **how)


def passed(folder: Path, releases: Path, without: tuple[str, ...], *tests: str) -> int:
    """Return how many of the core's quick tests pass; those that need a plug-in are skipped, and
    none may fail.
    """
    plugins = ("without_plugins", "no:cacheprovider", "no:randomly")
    words = [
        "-m",
        "pytest",
        "-q",
        "-c",
        str(TESTS.parent / "pyproject.toml"),
        "--basetemp",
        str(folder / "temporary"),
    ]
    words += [word for name in plugins for word in ("-p", name)] + [
        str(TESTS / each) for each in tests
    ]
    environment = {
        "DEEPACCIDENT_WITHOUT": ",".join(without),
        "DEEPACCIDENT_TEST_RELEASES": str(releases),
    }
    ran = run_in(folder, *words, **environment)
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-2000:]
    told = ran.stdout.splitlines()[-1].replace(",", "").split()
    return int(told[told.index("passed") - 1])


@pytest.fixture(scope="module")
def releases(
    release_root: Path,
    release_root_b: Path,
    motion_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A folder with the session's releases, by their names."""
    folder, ignore = tmp_path_factory.mktemp("releases"), shutil.ignore_patterns(".deepaccident")
    for root in (release_root, release_root_b, motion_root):
        shutil.copytree(root, folder / root.name, copy_function=os.link, ignore=ignore)
    return folder


def test_every_folder_is_a_plugin_that_can_be_loaded() -> None:
    folders = {
        each.name for each in (PACKAGE / "plugins").iterdir() if (each / "__init__.py").is_file()
    }
    found = own_plugins()
    assert (
        ({plugin.name for plugin in found.plugins}, found.refused)
        == (folders, {})
        == (set(OWN), {})
    )


def test_every_verb_is_that_of_its_name() -> None:
    verbs = offers(lambda plugin: plugin.verbs, own=True).by_name
    assert {name: verb.load().name for name, verb in verbs.items()} == {
        name: name.split()[-1] for name in verbs
    }
    assert [name for name, verb in verbs.items() if not verb.summary.endswith(".")] == []


def test_a_folder_that_an_uninstalled_plugin_left_is_no_plugin(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "attic" / "__pycache__").mkdir(parents=True)
    monkeypatch.setattr(plugins, "_FOLDER", tmp_path)
    for name in ("attic", "nowhere"):
        with pytest.raises(
            MissingPluginError,
            match=f"^a view: needs the plug-in {name}, which this installation lac",
        ):
            plugins.need_plugin(name, "a view")


def test_a_checkout_works_without_being_installed(tmp_path: Path) -> None:
    shown = run_in(copy_without(tmp_path), "-m", "deepaccident_devkit", "--help").stdout
    listed = {
        line.split()[0] for line in shown.splitlines() if line.startswith("  ") and line.strip()
    }
    assert {
        name for name in offers(lambda plugin: plugin.verbs, own=True).by_name if " " not in name
    } <= listed


@pytest.mark.slow
@pytest.mark.parametrize("name", OWN)
def test_without_a_plugin(name: str, releases: Path, tmp_path: Path) -> None:
    folder = copy_without(tmp_path, name)
    ran = run_in(
        folder,
        "-W",
        "ignore",
        "-c",
        PROBE,
        json.dumps([str(releases / "layout_b"), WORKS, NEEDED[name]]),
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    place, modules, named = json.loads(ran.stdout.splitlines()[-1])
    assert Path(place).parent.parent == folder
    assert modules > MODULES_OF_THE_CORE
    assert named.keys() == set(NEEDED[name])
    assert [
        text
        for text in named.values()
        if f"needs the plug-in {name}" not in text and "needs a plug-in" not in text
    ] == []
    tests = (
        "unit/selection/test_selection.py",
        "unit/collisions/test_contact.py",
        "unit/geometry/test_boxes.py",
    )
    assert passed(folder, releases, (name,), *tests) > 40


@pytest.mark.slow
def test_the_commands_of_the_core_alone(tmp_path: Path) -> None:
    folder = copy_without(tmp_path, *OWN)
    verb = run_in(folder, "-m", "deepaccident_devkit", "synth", "made")
    assert (verb.returncode, verb.stdout) == (2, "")
    assert "No such command 'synth'." in verb.stderr
    shown, whole = (
        run_in(place, "-m", "deepaccident_devkit", "--help").stdout
        for place in (folder, PACKAGE.parent)
    )
    missing = [
        line.split()[0]
        for line in whole.splitlines()
        if line not in shown and line.startswith("  ")
    ]
    assert set(missing) >= {"demo", "explore", "predict", "safety", "study", "synth", "train"}


FOLDERS = (
    "collisions",
    "geometry",
    "motion",
    "release",
    "statistics",
    "support/parallel",
    "tables",
    "v2x",
)


@pytest.mark.slow
def test_the_core_alone(releases: Path, tmp_path: Path) -> None:
    assert (
        passed(copy_without(tmp_path, *OWN), releases, OWN, *(f"unit/{each}" for each in FOLDERS))
        > 1000
    )
