"""Issue templates name existing commands, and wheel and sdist hold exactly the needed files."""

import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest
from click.testing import CliRunner
from support.repository_scripts import TOP
from support.text_contents import missing_parts

from deepaccident_devkit.cli import deepaccident

TEMPLATES = sorted((TOP / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
BUILD_FILES = (
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CITATION.cff",
    "SECURITY.md",
)


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_the_templates_ask_for_commands_that_exist(path: Path) -> None:
    commands = re.findall(r"`deepaccident ([^`]*)`", path.read_text(encoding="utf-8"))
    assert ("--version --all" in commands) == (path.name != "config.yml")
    for verb, *options in map(str.split, commands):
        words = [verb, *options] if verb.startswith("-") else [verb, "--help"]
        result = CliRunner().invoke(deepaccident, words)
        assert result.exit_code == 0
        if not verb.startswith("-"):
            long_options = [word for word in options if word.startswith("--")]
            assert missing_parts(result.output, *long_options) == []


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a wheel and an sdist that were built from a copy, without network."""
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path_factory.mktemp("source")
    for name in BUILD_FILES:
        shutil.copy(TOP / name, source)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(TOP / "deepaccident_devkit", source / "deepaccident_devkit", ignore=ignore)
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
    metadata = {name for name in names if ".dist-info/" in name}
    assert names - metadata == package_files() > {"deepaccident_devkit/py.typed"}
    metadata_names = ("LICENSE", "METADATA", "RECORD", "WHEEL", "entry_points.txt", "top_level.txt")
    assert {name.rpartition("/")[2] for name in metadata} == {*metadata_names}


@pytest.mark.slow
def test_an_sdist_holds_the_package_and_the_files_that_build_it(distributions: Path) -> None:
    [sdist] = distributions.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        members = [member for member in archive.getmembers() if member.isfile()]
    names = {member.name.partition("/")[2] for member in members}
    expected = {*package_files(), *BUILD_FILES, "PKG-INFO", "setup.cfg"}
    assert {name for name in names if ".egg-info/" not in name} == expected


USER_CODE = """
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import Boxes

da = DeepAccident(dataroot="release")
boxes: Boxes = da.boxes(da.samples("train", "evaluate")[0], frame="ego")
reveal_type(boxes.center)
reveal_type(da.get_sample)
boxes.no_such_field
"""


@pytest.mark.slow
def test_a_users_type_checker_reads_the_types(distributions: Path, tmp_path: Path) -> None:
    """`py.typed` ships in the wheel, so the annotations reach the users of the package."""
    pytest.importorskip("mypy")
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    [site_packages] = environment.glob("lib/python*/site-packages")
    [wheel] = distributions.glob("*.whl")
    shutil.unpack_archive(wheel, site_packages, "zip")
    (site_packages / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    (tmp_path / "user_code.py").write_text(USER_CODE, encoding="utf-8")
    python = environment / "bin" / "python"
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", python]

    process = subprocess.run(
        [*command, "user_code.py"], cwd=tmp_path, capture_output=True, text=True, check=False
    )

    output = process.stdout
    assert re.search(r'Revealed type is "numpy\.ndarray\[', output), output
    assert "def (" in output
    assert '"Boxes" has no attribute "no_such_field"' in output
    assert output.rstrip().endswith("Found 1 error in 1 file (checked 1 source file)")
