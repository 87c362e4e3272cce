"""The code on docs/testing.md runs as it is."""

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "testing.md").read_text(encoding="utf-8")
TEST_CODE, CONFTEST_CODE, PLAIN_CODE, STRATEGY_CODE = re.findall(
    r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE
)
MY_LOADER = """
import pytest
from deepaccident_devkit import DeepAccident
from deepaccident_devkit import DeepAccidentError as MyError
from deepaccident_devkit.errors import MissingFileError

def my_loader(root):
    da = DeepAccident("v1", root, workers=1, verbose=False)
    for sample in da.sample:
        try:
            yield da.load_point_cloud(sample)
        except MissingFileError:
            yield None

def my_parser(text):
    return [row for row in map(str.split, text.splitlines()[1:]) if len(row) > 1]
"""


def test_the_tests_on_the_page_pass_in_a_project_of_somebody_else(foreign) -> None:
    (foreign.folder / "mine.py").write_text(MY_LOADER)
    (foreign.folder / "test_mine.py").write_text(TEST_CODE)
    (foreign.folder / "test_property.py").write_text(STRATEGY_CODE)
    process = foreign.pytest(
        "-k", "every_label or (layout_A and not (label or meta or split or files))"
    )
    assert " passed" in process.stdout, process.stdout + process.stderr
    assert "failed" not in process.stdout, process.stdout


def test_the_conftest_on_the_page_says_what_the_releases_are_like(foreign) -> None:
    (foreign.folder / "conftest.py").write_text(CONFTEST_CODE.replace("frames=20", "frames=2"))
    (foreign.folder / "test_mine.py").write_text(
        "def test_release(deepaccident_release):\n"
        "    assert len(list(deepaccident_release.glob('train/*/*/label/*/*.txt'))) == 2 * 5 * 2\n"
        "    assert not list(deepaccident_release.rglob('*.jpg'))\n"
    )
    process = foreign.pytest()
    assert "1 passed" in process.stdout, process.stdout + process.stderr


def test_the_code_without_pytest_runs(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(PLAIN_CODE, "testing.md", "exec"), {})  # noqa: S102
    assert "_002.txt A position is NaN." in capsys.readouterr().out
