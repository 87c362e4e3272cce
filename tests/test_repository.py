"""Templates of issues name commands that exist; a wheel and a source archive hold what they
should.
"""

import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner
from test_words import TOP

from deepaccident_devkit.cli import deepaccident

TEMPLATES = sorted((TOP / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
BUILT = (
    *(
        "pyproject.toml",
        "setup.py",
        "MANIFEST.in",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "CITATION.cff",
    ),
    "SECURITY.md",
)


def parsed(path: Path) -> dict:
    return yaml.safe_load(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_the_templates_ask_for_commands_that_exist(path: Path) -> None:
    commands = re.findall(r"`deepaccident ([^`]*)`", path.read_text(encoding="utf-8"))
    assert ("--version --all" in commands) == (path.name != "config.yml")
    for verb, *options in map(str.split, commands):
        words = [verb, *options] if verb.startswith("-") else [verb, "--help"]
        result = CliRunner().invoke(deepaccident, words)
        assert result.exit_code == 0
        assert (
            verb.startswith("-")
            or [word for word in options if word[:2] == "--" and word not in result.output] == []
        )


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
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], cwd=source, check=True, capture_output=True
    )
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
    assert {name for name in names if ".egg-info/" not in name} == package_files() | set(
        BUILT
    ) | made


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
    [installed], [wheel] = (
        environment.glob("lib/python*/site-packages"),
        distributions.glob("*.whl"),
    )
    shutil.unpack_archive(wheel, installed, "zip")
    (installed / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    (tmp_path / "stranger.py").write_text(STRANGER, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--python-executable",
        environment / "bin" / "python",
    ]
    found = subprocess.run(
        [*command, "stranger.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    ).stdout
    assert re.search(r'Revealed type is "numpy\.ndarray\[', found), found
    assert ("def (" in found, '"Boxes" has no attribute "no_such_field"' in found) == (True, True)
    assert found.rstrip().endswith("Found 1 error in 1 file (checked 1 source file)")
