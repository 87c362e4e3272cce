"""Without a plug-in, the core and its tests work, and a message names the missing plug-in."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.text_contents import missing_parts

import deepaccident_devkit
from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.support import plugins
from deepaccident_devkit.support.plugins import offers, own_plugins

TESTS = Path(__file__).parent
PACKAGE = Path(deepaccident_devkit.__file__).parent
PLUGINS = ("audit", "baselines", "explore", "model", "nuscenes", "safety", "study", "synth")
MIN_CORE_MODULES = 200
NEEDING_PLUGIN = {
    "audit": (),
    "baselines": ("verb('demo')", "verb('study')"),
    "explore": (),
    "model": ("verb('predict', str(da.dataroot), str(da.dataroot), '--out', 'predicted')",),
    "nuscenes": (),
    "safety": ("verb('explore')", "list(further_results({'prevented': {'interval_notes': []}}))"),
    "study": (),
    "synth": ("verb('study')",),
}
"""Plug-in → expressions of `PROBE` that need it, besides its own verbs."""
CORE_EXPRESSIONS = (
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

root, core_expressions, needing_plugin = json.loads(sys.argv[1])
modules = pkgutil.walk_packages(
    deepaccident_devkit.__path__, "deepaccident_devkit.", onerror=lambda name: None)
core = [module.name for module in modules
    if not module.name.startswith("deepaccident_devkit.plugins.") and not module.name.endswith("__main__")]
for name in core:
    try:
        importlib.import_module(name)
    except MissingExtraError:
        pass
    except ModuleNotFoundError as error:  # a module in a package that needs an extra
        assert error.name == "torch", error

def verb(*words):
    result = CliRunner().invoke(deepaccident, words, catch_exceptions=False)
    assert result.exit_code < 2, result.output

da = DeepAccident("v1", root, verbose=False)
for expression in core_expressions:
    eval(expression)
messages = {}
for expression in needing_plugin:
    try:
        eval(expression)
    except MissingPluginError as error:
        messages[expression] = str(error)
print(json.dumps([deepaccident_devkit.__file__, len(core), messages]))
"""  # noqa: E501


def copy_without(folder: Path, *without: str) -> Path:
    """Copy the package into a folder, without some plug-ins.

    An editable installation of the package cannot provide them either.
    """
    shutil.copytree(PACKAGE, folder / PACKAGE.name)
    for name in without:
        shutil.rmtree(folder / PACKAGE.name / "plugins" / name)
    (folder / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [finder for finder in sys.meta_path if "
        "'__editable__' not in str(finder)]\n"
    )
    return folder


def run_in(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python on the copy of the package in a folder."""
    paths = os.pathsep.join([str(folder), str(TESTS)])
    return subprocess.run(
        [sys.executable, *words],
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths, "MPLBACKEND": "Agg", **environment},
        capture_output=True,
        text=True,
        timeout=1800,
    )


def count_passed_tests(folder: Path, releases: Path, without: tuple[str, ...], *tests: str) -> int:
    """Run quick tests of the core without some plug-ins, and return how many pass.

    Tests that need a plug-in are skipped; none may fail.
    """
    configuration = ("-c", str(TESTS.parent / "pyproject.toml"))
    folders = ("--basetemp", str(folder / "temporary"))
    plugins = ("-p", "support.skipped_plugins", "-p", "no:cacheprovider", "-p", "no:randomly")
    paths = [str(TESTS / name) for name in tests]
    process = run_in(
        folder,
        *("-m", "pytest", "-q", *configuration, *folders, *plugins, *paths),
        DEEPACCIDENT_WITHOUT=",".join(without),
        DEEPACCIDENT_TEST_RELEASES=str(releases),
    )
    assert process.returncode == 0, process.stdout[-4000:] + process.stderr[-2000:]
    summary = process.stdout.splitlines()[-1].replace(",", "").split()
    return int(summary[summary.index("passed") - 1])


@pytest.fixture(scope="module")
def releases(
    release_root: Path,
    release_root_b: Path,
    motion_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A folder with the session's releases, by their names."""
    folder = tmp_path_factory.mktemp("releases")
    ignore = shutil.ignore_patterns(".deepaccident")
    for root in (release_root, release_root_b, motion_root):
        shutil.copytree(root, folder / root.name, copy_function=os.link, ignore=ignore)
    return folder


def test_every_folder_is_a_plugin_that_can_be_loaded() -> None:
    folders = {path.parent.name for path in PACKAGE.glob("plugins/*/__init__.py")}
    discovery = own_plugins()
    assert {plugin.name for plugin in discovery.plugins} == folders == set(PLUGINS)
    assert discovery.refused == {}


def test_every_verb_loads_the_command_of_its_name() -> None:
    verbs = offers(lambda plugin: plugin.verbs, own=True).by_name
    for name, verb in verbs.items():
        assert verb.load().name == name.split()[-1]
        assert verb.summary.endswith("."), name


def test_a_folder_without_a_module_is_no_plugin(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "attic" / "__pycache__").mkdir(parents=True)
    monkeypatch.setattr(plugins, "_FOLDER", tmp_path)
    for name in ("attic", "nowhere"):
        message = f"^a view: needs the plug-in {name}, which is not inst"
        with pytest.raises(MissingPluginError, match=message):
            plugins.need_plugin(name, "a view")


def test_a_checkout_works_without_being_installed(tmp_path: Path) -> None:
    output = run_in(copy_without(tmp_path), "-m", "deepaccident_devkit", "--help").stdout
    listed_verbs = re.findall(r"^  +(\S+)", output, re.MULTILINE)
    verbs = offers(lambda plugin: plugin.verbs, own=True).by_name
    assert missing_parts(listed_verbs, *(name for name in verbs if " " not in name)) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", PLUGINS)
def test_without_a_plugin(name: str, releases: Path, tmp_path: Path) -> None:
    folder = copy_without(tmp_path, name)
    arguments = [str(releases / "layout_b"), CORE_EXPRESSIONS, NEEDING_PLUGIN[name]]

    process = run_in(folder, "-W", "ignore", "-c", PROBE, json.dumps(arguments))

    assert process.returncode == 0, process.stdout + process.stderr
    path, num_modules, messages = json.loads(process.stdout.splitlines()[-1])
    assert Path(path).parent.parent == folder
    assert num_modules > MIN_CORE_MODULES
    assert messages.keys() == set(NEEDING_PLUGIN[name])
    for message in messages.values():
        assert f"needs the plug-in {name}" in message or "needs a plug-in" in message
    tests = (
        "unit/selection/test_selection.py",
        "unit/collisions/test_contact.py",
        "unit/geometry/test_boxes.py",
    )
    assert count_passed_tests(folder, releases, (name,), *tests) > 40


@pytest.mark.slow
def test_the_commands_without_plugins(tmp_path: Path) -> None:
    folder = copy_without(tmp_path, *PLUGINS)
    process = run_in(folder, "-m", "deepaccident_devkit", "synth", "made")
    assert (process.returncode, process.stdout) == (2, "")
    assert "No such command 'synth'." in process.stderr

    core_help = run_in(folder, "-m", "deepaccident_devkit", "--help").stdout
    full_help = run_in(PACKAGE.parent, "-m", "deepaccident_devkit", "--help").stdout
    missing_verbs = {
        line.split()[0]
        for line in full_help.splitlines()
        if line not in core_help and line.startswith("  ")
    }
    assert missing_verbs >= {"demo", "explore", "predict", "safety", "study", "synth", "train"}


CORE_TEST_FOLDERS = ("collisions", "geometry", "statistics", "support/parallel", "tables")


@pytest.mark.slow
def test_the_tests_of_the_core_without_plugins(releases: Path, tmp_path: Path) -> None:
    folder = copy_without(tmp_path, *PLUGINS)
    tests = [f"unit/{name}" for name in CORE_TEST_FOLDERS]
    assert count_passed_tests(folder, releases, PLUGINS, *tests) > 400
