"""`.ci/run` reports each failure by name and goes on; a release states one version everywhere."""

import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest
from support.repository_scripts import TOP, load_script

SCRIPT_HEAD = "# a step\nsource .ci/tools/step.sh\n"
CHECKS_BY_STEP = {
    "good": 'check tests echo "5 passed in 1.00s"\n',
    "lint": "check format true\ncheck lint bash -c 'echo a long line; exit 3'\ncheck types true\n",
    "tests": "check tests bash -c 'cat FILE; exit 1'\n",
    "stops": "check first true\nno_such_command\ncheck second true\n",
    "empty": "",
}
PYTEST_OUTPUT = """5 passed
====== FAILURES ======
E  assert 1 == 2
====== short test summary info ======
FAILED tests/test_one.py::test_two - assert 1 == 2
====== 1 failed, 4 passed in 2.00s ======
"""


def test_a_failure_is_reported_by_name_and_the_other_steps_run(tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    shutil.copytree(
        TOP / ".ci", repository / ".ci", ignore=shutil.ignore_patterns("steps", "node_modules")
    )
    subprocess.run(["git", "init", "--quiet", repository], check=True)
    output = tmp_path / "output.txt"
    output.write_text(PYTEST_OUTPUT)
    for name, checks in CHECKS_BY_STEP.items():
        script = repository / ".ci" / "steps" / f"{name}.sh"
        script.parent.mkdir(exist_ok=True)
        script.write_text(SCRIPT_HEAD + checks.replace("FILE", str(output)) + "wait\n")

    process = subprocess.run(
        [repository / ".ci" / "run", *CHECKS_BY_STEP], capture_output=True, text=True, check=False
    )

    assert process.returncode == 1
    table, _, details = process.stdout.partition("\nstep ")[2].partition("====")
    results = dict(re.findall(r"^(\w+) +(passed|FAILED) +\d+$", table, re.MULTILINE))
    assert results.pop("all") == "FAILED"
    assert {name for name, result in results.items() if result == "passed"} == {"good"}
    failures, _, summary = details.partition("==== test summary")
    assert "lint: lint\na long line" in f" {failures}"
    assert "E  assert 1 == 2" in failures
    assert "no_such_command" in failures
    assert "FAILED tests/test_one.py::test_two - assert 1 == 2" in summary
    passed_index = summary.index("good, tests: 5 passed")
    assert passed_index < summary.index("tests, tests: 1 failed, 4 passed")


def test_an_unknown_step_is_refused() -> None:
    process = subprocess.run(
        [TOP / ".ci" / "run", "quik"], capture_output=True, text=True, check=False
    )
    assert process.returncode == 2
    assert "quik" in process.stderr


@pytest.fixture(scope="module")
def release_script() -> ModuleType:
    return load_script(".ci/tools/release.py")


@pytest.fixture
def checkout(release_script: ModuleType, tmp_path: Path) -> Path:
    """A copy of the files that state the version or an address."""
    other_names = ("pyproject.toml", "RELEASING.md", ".github/ISSUE_TEMPLATE/config.yml")
    for name in (*release_script.PLACES, *other_names):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(TOP / name, tmp_path / name)
    return tmp_path


def test_all_files_state_the_same_version(release_script: ModuleType) -> None:
    assert list(release_script.disagreements(TOP, None)) == []


def test_a_version_is_set_everywhere(release_script: ModuleType, checkout: Path) -> None:
    old_notes = release_script.notes_of(checkout)
    (checkout / "RELEASING.md").write_text("    owner = someone\n")

    assert release_script.main(["set", "1.2.0"], checkout) == 0

    assert list(release_script.disagreements(checkout, "v1.2.0")) == []
    assert release_script.STABLE in (checkout / "pyproject.toml").read_text()
    assert release_script.notes_of(checkout) != old_notes
    names = ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    texts = {name: (checkout / name).read_text() for name in names}
    assert "github.com/someone/" in texts["pyproject.toml"]
    assert "github.com/someone/" in texts["CITATION.cff"]

    release_script.main(["set", "1.2.0"], checkout)
    assert {name: (checkout / name).read_text() for name in names} == texts


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("CITATION.cff", "version: 1.2.0rc1", "version: 1.1.0"),
        ("CHANGELOG.md", "## [1.2.0rc1]", "## [1.1.0]"),
        ("pyproject.toml", "4 - Beta", "5 - Production/Stable"),
        ("RELEASING.md", "owner = someone", "owner ="),
    ],
)
def test_a_release_is_refused_if_a_file_disagrees(
    release_script: ModuleType,
    checkout: Path,
    capsys: pytest.CaptureFixture[str],
    file: str,
    old: str,
    new: str,
) -> None:
    (checkout / "RELEASING.md").write_text("    owner = someone\n")
    release_script.main(["set", "1.2.0rc1"], checkout)
    path = checkout / file
    path.write_text(path.read_text().replace(old, new))
    capsys.readouterr()

    assert release_script.main(["check", "v1.2.0rc1"], checkout) == 1
    assert capsys.readouterr().out.startswith(file)


@pytest.mark.parametrize("words", [["set", "1.2"], ["set"], ["publish"], []])
def test_a_wrong_command_changes_nothing(
    release_script: ModuleType, checkout: Path, words: list[str]
) -> None:
    before = (checkout / "CITATION.cff").read_text()
    assert release_script.main(words, checkout) == 2
    assert (checkout / "CITATION.cff").read_text() == before
