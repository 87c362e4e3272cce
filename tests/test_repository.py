"""Citation, hooks, workflow and templates say what is so; a wheel and an sdist hold what they should."""

import ast
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from fnmatch import fnmatch
from functools import cache
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from test_words import TOP

from deepaccident_devkit import __version__
from deepaccident_devkit.cli import deepaccident

CI = (TOP / ".ci" / "run").read_text(encoding="utf-8")
PYPROJECT = (TOP / "pyproject.toml").read_text(encoding="utf-8")
TEMPLATES = sorted((TOP / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
BUILT = (
    *("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"),
    "SECURITY.md",
)


def parsed(path: Path) -> dict:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def test_the_citation_is_of_this_version_and_of_the_paper() -> None:
    citation = parsed(TOP / "CITATION.cff")
    paper, readme = citation["preferred-citation"], " ".join((TOP / "README.md").read_text(encoding="utf-8").split())
    assert (citation["version"], paper["title"] in readme, paper["url"] in readme) == (__version__, True, True)


def test_a_run_ends_where_a_worker_crashes(pytestconfig: pytest.Config) -> None:
    """Restarted workers make pytest-xdist wait for ever, where the tests of a file stay together."""
    assert pytestconfig.getoption("maxworkerrestart", "0") == "0"  # none without pytest-xdist


def test_the_hooks_are_checks_of_ci() -> None:
    [local] = parsed(TOP / ".pre-commit-config.yaml")["repos"]
    for hook in local["hooks"]:
        command = hook["entry"].removesuffix(" --force-exclude")
        assert re.search(rf"^{re.escape(command)}( \.)?$", CI, re.MULTILINE), hook["id"]


def test_the_workflow_runs_ci_on_every_python() -> None:
    job = parsed(TOP / ".github" / "workflows" / "ci.yml")["jobs"]["ci"]
    assert job["strategy"]["matrix"]["python"] == re.findall(r"Python :: (3\.\d+)", PYPROJECT)
    assert "bash .ci/run" in [step.get("run") for step in job["steps"]]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_the_templates_ask_for_commands_that_exist(path: Path) -> None:
    commands = re.findall(r"`deepaccident ([^`]*)`", path.read_text(encoding="utf-8"))
    assert ("--version --all" in commands) == (path.name != "config.yml")
    for verb, *options in map(str.split, commands):
        words = [verb, *options] if verb.startswith("-") else [verb, "--help"]
        result = CliRunner().invoke(deepaccident, words)
        assert result.exit_code == 0
        assert (
            verb.startswith("-") or [word for word in options if word[:2] == "--" and word not in result.output] == []
        )


@cache
def slow_tests() -> dict[str, list[ast.FunctionDef]]:
    """File → its test functions that are marked slow, themselves, by their class or by the whole file."""

    def marked(where: ast.AST) -> bool:
        set_here = [each for each in getattr(where, "body", ()) if isinstance(each, ast.Assign)]
        marks = [each.value for each in set_here if ast.unparse(each.targets[0]) == "pytestmark"]
        return any("mark.slow" in ast.unparse(each) for each in (*marks, *getattr(where, "decorator_list", ())))

    found: dict[str, list[ast.FunctionDef]] = {}
    for path in sorted((TOP / "tests").rglob("test_*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for room in (tree, *(each for each in tree.body if isinstance(each, ast.ClassDef))):
            tests = [each for each in room.body if isinstance(each, ast.FunctionDef) and each.name.startswith("test_")]
            if slow := [test for test in tests if marked(tree) or marked(room) or marked(test)]:
                found.setdefault(path.relative_to(TOP).as_posix(), []).extend(slow)
    return found


@pytest.mark.slow
def test_the_list_of_slow_tests_is_complete() -> None:
    section = (TOP / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Slow tests")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`.*) \| .* \|$", section, re.MULTILINE)
    listed = [pattern for row in rows for pattern in row.split(", ")]
    files = {name: [each for each in listed if fnmatch(name, each.strip("`"))] for name in slow_tests()}
    assert {name: patterns for name, patterns in files.items() if len(patterns) != 1} == {}
    assert {pattern for patterns in files.values() for pattern in patterns} == set(listed)


@pytest.mark.slow
def test_no_parity_and_no_property_is_slow() -> None:
    slow = slow_tests()
    assert [name for name in slow if name.startswith(("tests/parity/", "tests/property/"))] == []
    marks = {
        f"{name}::{each.name}": " ".join(map(ast.unparse, each.decorator_list))
        for name, tests in slow.items()
        for each in tests
    }
    assert [name for name, text in marks.items() if re.search(r"\bgiven\(|golden", text)] == []


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a wheel and an sdist, built from a copy without network."""
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path_factory.mktemp("source")
    for name in BUILT:
        shutil.copy(TOP / name, source)
    unwanted = shutil.ignore_patterns("__pycache__")
    shutil.copytree(TOP / "deepaccident_devkit", source / "deepaccident_devkit", ignore=unwanted)
    (source / "tests").mkdir()
    shutil.copy(__file__, source / "tests")
    code = "from setuptools import build_meta as b; b.build_wheel('dist'); b.build_sdist('dist')"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], cwd=source, check=True, capture_output=True)
    return source / "dist"


def package_files() -> set[str]:
    return {
        path.relative_to(TOP).as_posix()
        for path in (TOP / "deepaccident_devkit").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.slow
def test_a_wheel_holds_the_package_and_nothing_else(distributions: Path) -> None:
    [wheel] = distributions.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    facts = {name for name in names if ".dist-info/" in name}
    assert names - facts == package_files() > {"deepaccident_devkit/py.typed"}
    told = ("LICENSE", "METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt")
    assert {name.rpartition("/")[2] for name in facts} == {*told}


@pytest.mark.slow
def test_an_sdist_holds_the_package_and_what_builds_it(distributions: Path) -> None:
    [sdist] = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {each.name.partition("/")[2] for each in archive.getmembers() if each.isfile()}
    made = {"PKG-INFO", "setup.cfg"}
    assert {name for name in names if ".egg-info/" not in name} == package_files() | set(BUILT) | made


STRANGER = """
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import Boxes

da = DeepAccident(dataroot="release")
boxes: Boxes = da.boxes(da.samples("train", "evaluate")[0], frame="ego")
reveal_type(boxes.center)
reveal_type(da.get_sample)
boxes.no_such_field
"""


@pytest.mark.slow
def test_a_strangers_type_checker_reads_the_types(distributions: Path, tmp_path: Path) -> None:
    """`py.typed` ships in the wheel, and annotations reach those who use the package."""
    pytest.importorskip("mypy")
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    [installed], [wheel] = environment.glob("lib/python*/site-packages"), distributions.glob("*.whl")
    shutil.unpack_archive(wheel, installed, "zip")
    (installed / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    (tmp_path / "stranger.py").write_text(STRANGER, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", environment / "bin" / "python"]
    found = subprocess.run([*command, "stranger.py"], cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    assert re.search(r'Revealed type is "numpy\.ndarray\[', found), found
    assert ("def (" in found, '"Boxes" has no attribute "no_such_field"' in found) == (True, True)
    assert found.rstrip().endswith("Found 1 error in 1 file (checked 1 source file)")
