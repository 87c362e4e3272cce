"""`.ci/run` reports each failure by name and goes on; a release states one version everywhere."""

import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest
from scripts import TOP, loaded_script

BEGIN = "# a step\nsource .ci/tools/step.sh\n"
STEPS = {
    "good": 'check tests echo "5 passed in 1.00s"\n',
    "lint": "check format true\ncheck lint bash -c 'echo a long line; exit 3'\ncheck types true\n",
    "tests": "check tests bash -c 'cat FILE; exit 1'\n",
    "stops": "check first true\nno_such_command\ncheck second true\n",
    "empty": "",
}
FAILURES = """5 passed
====== FAILURES ======
E  assert 1 == 2
====== short test summary info ======
FAILED tests/test_one.py::test_two - assert 1 == 2
====== 1 failed, 4 passed in 2.00s ======
"""


def test_a_failure_is_reported_by_name_and_the_other_steps_run(tmp_path: Path) -> None:
    repository, output = tmp_path / "repository", tmp_path / "output.txt"
    shutil.copytree(
        TOP / ".ci", repository / ".ci", ignore=shutil.ignore_patterns("steps", "node_modules")
    )
    subprocess.run(["git", "init", "--quiet", repository], check=True)
    output.write_text(FAILURES)
    for name, checks in STEPS.items():
        script = repository / ".ci" / "steps" / f"{name}.sh"
        script.parent.mkdir(exist_ok=True)
        script.write_text(BEGIN + checks.replace("FILE", str(output)) + "wait\n")
    done = subprocess.run(
        [repository / ".ci" / "run", *STEPS], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    table, _, rest = done.stdout.partition("\nstep ")[2].partition("====")
    results = dict(re.findall(r"^(\w+) +(passed|FAILED) +\d+$", table, re.MULTILINE))
    assert results.pop("all") == "FAILED"
    assert {name for name, result in results.items() if result == "passed"} == {"good"}
    failures, _, summary = rest.partition("==== test summary")
    assert "lint: lint\na long line" in f" {failures}"
    assert "E  assert 1 == 2" in failures
    assert "no_such_command" in failures
    assert "FAILED tests/test_one.py::test_two - assert 1 == 2" in summary
    assert summary.index("good, tests: 5 passed") < summary.index(
        "tests, tests: 1 failed, 4 passed"
    )


def test_an_unknown_step_is_refused() -> None:
    done = subprocess.run(
        [TOP / ".ci" / "run", "quik"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, "quik" in done.stderr) == (2, True)


@pytest.fixture(scope="module")
def release() -> ModuleType:
    return loaded_script(".ci/tools/release.py")


@pytest.fixture
def copy(release: ModuleType, tmp_path: Path) -> Path:
    """The files that state the version or an address."""
    for name in (
        *release.PLACES,
        "pyproject.toml",
        "RELEASING.md",
        ".github/ISSUE_TEMPLATE/config.yml",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(TOP / name, tmp_path / name)
    return tmp_path


def test_all_files_state_the_same_version(release: ModuleType) -> None:
    assert list(release.disagreements(TOP, None)) == []


def test_a_version_is_set_everywhere(release: ModuleType, copy: Path) -> None:
    notes = release.notes_of(copy)
    (copy / "RELEASING.md").write_text("    owner = someone\n")
    assert release.main(["set", "1.2.0"], copy) == 0
    assert list(release.disagreements(copy, "v1.2.0")) == []
    assert release.STABLE in (copy / "pyproject.toml").read_text()
    assert release.notes_of(copy) != notes
    once = {
        name: (copy / name).read_text()
        for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    }
    assert all("github.com/someone/" in once[name] for name in ("pyproject.toml", "CITATION.cff"))
    release.main(["set", "1.2.0"], copy)
    assert once == {name: (copy / name).read_text() for name in once}


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("CITATION.cff", "version: 1.2.0rc1", "version: 1.1.0"),
        ("CHANGELOG.md", "## [1.2.0rc1]", "## [1.1.0]"),
        ("pyproject.toml", "4 - Beta", "5 - Production/Stable"),
        ("RELEASING.md", "owner = someone", "owner ="),
    ],
)
def test_a_release_is_refused_where_a_file_disagrees(
    release: ModuleType,
    copy: Path,
    capsys: pytest.CaptureFixture[str],
    file: str,
    old: str,
    new: str,
) -> None:
    (copy / "RELEASING.md").write_text("    owner = someone\n")
    release.main(["set", "1.2.0rc1"], copy)
    path = copy / file
    path.write_text(path.read_text().replace(old, new))
    capsys.readouterr()
    assert release.main(["check", "v1.2.0rc1"], copy) == 1
    assert capsys.readouterr().out.startswith(file)


@pytest.mark.parametrize("words", [["set", "1.2"], ["set"], ["publish"], []])
def test_a_wrong_command_changes_nothing(release: ModuleType, copy: Path, words: list[str]) -> None:
    before = (copy / "CITATION.cff").read_text()
    assert release.main(words, copy) == 2
    assert (copy / "CITATION.cff").read_text() == before
