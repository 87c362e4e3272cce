"""The core without each room of the ring: it imports, its commands run, its tests pass, and it names what lacks."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import deepaccident_devkit
from deepaccident_devkit import rooms
from deepaccident_devkit.errors import MissingRoomError

TESTS = Path(__file__).parent
PACKAGE = Path(deepaccident_devkit.__file__).parent
RING = (
    "audit",
    "baselines",
    "explore",
    "interactions",
    "maps",
    "model",
    "nuscenes",
    "safety",
    "study",
    "synth",
    "testing",
)
MODULES_OF_THE_CORE = 200
ASKED = {
    "audit": ("verb('audit')",),
    "baselines": ("verb('predict')", "verb('demo')", "verb('study')"),
    "explore": ("verb('explore')",),
    "interactions": (
        "da.find(min_ttc='..1')",
        "da.find('max_drac>9')",
        "da.interactions(da.scenario[0])",
        "dataset_statistics(da, interactions=True)",
        "verb('safety')",
        "verb('explore')",
    ),
    "maps": (
        "da.town_map('Town03')",
        "da.render_town_map('Town03')",
        "render.render_town_map",
        "da.render_bev(da.sample[0], layers=('map', 'boxes'))",
        "verb('export', 'town-maps')",
        "verb('explore')",
    ),
    "model": ("verb('train')", "verb('predict', str(da.dataroot), str(da.dataroot), '--out', 'predicted')"),
    "nuscenes": ("verb('rigs')",),
    "safety": ("da.describe(da.scenario[0])", "verb('safety')", "verb('explore')"),
    "study": ("verb('study')",),
    "synth": ("verb('synth')", "verb('demo')", "verb('study')"),
    "testing": ("verb('audit')",),
}
"""Room → what cannot be had without it, in terms of `PROBE`."""
WORKS = (
    "verb('--help')",
    "verb('info', str(da.dataroot))",
    "verb('info', '--fields')",
    "verb('evaluate', '--help')",
    "verb('export', '--help')",
    "verb('render', '--help')",
    "verb('validate', str(da.dataroot))",
    "da.find('closing_speed>=0', town='Town03')",
    "da.render_bev(da.sample[0], layers=('bev', 'boxes'))",
    "dataset_statistics(da)",
)
PROBE = """
import importlib, json, pkgutil, sys, warnings
from click.testing import CliRunner
import deepaccident_devkit
from deepaccident_devkit import DeepAccident, render
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingExtraError, MissingRoomError
from deepaccident_devkit.statistics import dataset_statistics

root, ring, works, asked = json.loads(sys.argv[1])
names = [each.name for each in pkgutil.walk_packages(
    deepaccident_devkit.__path__, "deepaccident_devkit.", onerror=lambda name: None)]
core = [each for each in names if each.split(".")[1] not in ring and not each.endswith("__main__")]
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
    except MissingRoomError as error:
        named[expression] = str(error)
print(json.dumps([deepaccident_devkit.__file__, len(core), named]))
"""


def copy_without(folder: Path, *without: str) -> Path:
    """A copy of the package in a folder, without some rooms; of an editable installation none are found either."""
    shutil.copytree(PACKAGE, folder / PACKAGE.name)
    for room in without:
        shutil.rmtree(folder / PACKAGE.name / room)
    (folder / "sitecustomize.py").write_text(
        "import sys\nsys.meta_path[:] = [each for each in sys.meta_path if '__editable__' not in str(each)]\n"
    )
    return folder


def run_in(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A run of Python on the copy of the package in a folder."""
    paths = os.pathsep.join([str(folder), str(TESTS)])
    variables = {**os.environ, "PYTHONPATH": paths, "MPLBACKEND": "Agg", **environment}
    how: dict[str, Any] = {"cwd": folder, "env": variables, "capture_output": True, "text": True, "timeout": 1800}
    return subprocess.run([sys.executable, *words], check=False, **how)


def passed(folder: Path, releases: Path, without: tuple[str, ...], *tests: str) -> int:
    """How many of the core's quick tests pass; those that need a room themselves are skipped, and none may fail."""
    plugins = ("without_rooms", "no:cacheprovider", "no:randomly", *(["no:deepaccident"] * ("testing" in without)))
    words = ["-m", "pytest", "-q", "-c", str(TESTS.parent / "pyproject.toml"), "--basetemp", str(folder / "temporary")]
    words += [word for name in plugins for word in ("-p", name)] + [str(TESTS / each) for each in tests]
    environment = {"DEEPACCIDENT_WITHOUT": ",".join(without), "DEEPACCIDENT_TEST_RELEASES": str(releases)}
    ran = run_in(folder, *words, **environment)
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-2000:]
    told = ran.stdout.splitlines()[-1].replace(",", "").split()
    return int(told[told.index("passed") - 1])


@pytest.fixture(scope="module")
def releases(
    release_root: Path, release_root_b: Path, motion_root: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder with the session's releases, by their names."""
    folder, ignore = tmp_path_factory.mktemp("releases"), shutil.ignore_patterns(".deepaccident")
    for root in (release_root, release_root_b, motion_root):
        shutil.copytree(root, folder / root.name, copy_function=os.link, ignore=ignore)
    return folder


def test_the_tables_are_of_rooms() -> None:
    there = {each.name for each in PACKAGE.iterdir() if (each / "__init__.py").is_file()}
    modules = [place.partition(":")[0] for names in rooms.ADDED.values() for place in names.values()]
    assert {each.partition(".")[0] for each in modules} <= set(RING) < there
    assert {each.partition(".")[0] for each in rooms.NEEDS} | {*sum(rooms.NEEDS.values(), ())} <= set(RING)
    added = [(kind, name) for kind, names in rooms.ADDED.items() for name in names]
    assert [each for each in added if rooms.added(*each) is None] == []


def test_a_folder_that_an_uninstalled_room_left_is_no_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "attic" / "__pycache__").mkdir(parents=True)
    monkeypatch.setattr(deepaccident_devkit, "__path__", [*deepaccident_devkit.__path__, str(tmp_path)])
    for room in ("attic", "nowhere"):
        with pytest.raises(MissingRoomError, match=f"^a view: needs the room `{room}`, which this installation lacks"):
            rooms.need_room(room, "a view")
    rooms.need_room("safety", "a view")


@pytest.mark.slow
@pytest.mark.parametrize("room", RING)
def test_without_a_room(room: str, releases: Path, tmp_path: Path) -> None:
    folder = copy_without(tmp_path, room)
    told = json.dumps([str(releases / "layout_b"), RING, WORKS, ASKED[room]])
    ran = run_in(folder, "-W", "ignore", "-c", PROBE, told)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    place, modules, named = json.loads(ran.stdout.splitlines()[-1])
    assert Path(place).parent.parent == folder
    assert modules > MODULES_OF_THE_CORE
    assert named.keys() == set(ASKED[room])
    sentence = f"needs the room `{room}`, which this installation lacks; install the whole devkit"
    assert [text for text in named.values() if sentence not in text] == []
    tests = ("unit/selection/test_selection.py", "unit/accidents/test_contact.py", "unit/geometry/test_boxes.py")
    assert passed(folder, releases, (room,), *tests) > 40


@pytest.mark.slow
def test_the_commands_of_the_core_alone(tmp_path: Path) -> None:
    folder = copy_without(tmp_path, *RING)
    verb = run_in(folder, "-m", "deepaccident_devkit", "synth", "made")
    told = "error: synth: needs the room `synth`, which this installation lacks; install the whole devkit\n"
    assert (verb.returncode, verb.stdout, verb.stderr) == (2, "", told)
    shown, whole = (run_in(place, "-m", "deepaccident_devkit", "--help").stdout for place in (folder, PACKAGE.parent))
    assert shown == whole


FOLDERS = ("accidents", "geometry", "motion", "parallel", "release", "statistics", "tables", "v2x")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kept", "folders", "least"),
    [
        (("testing",), FOLDERS, 1000),  # with what draws the contents for most tests
        ((), tuple(each for each in FOLDERS if each != "release"), 200),
    ],
)
def test_the_core_alone(
    releases: Path, tmp_path: Path, kept: tuple[str, ...], folders: tuple[str, ...], least: int
) -> None:
    without = tuple(room for room in RING if room not in kept)
    assert passed(copy_without(tmp_path, *without), releases, without, *(f"unit/{each}" for each in folders)) > least
