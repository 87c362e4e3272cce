"""Validation on any executor and by several processes gives the same report and repeats no work."""

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from deepaccident_devkit.release import find_release
from deepaccident_devkit.validation import ScenarioCheck, validate_release
from deepaccident_devkit.validation import validate as module
from deepaccident_devkit.validation.validate import check_scenario


@pytest.fixture(scope="module")
def root(release_root_b: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a release of six scenarios with errors, warnings and notes."""
    root = tmp_path_factory.mktemp("validated") / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    first, second, third, *_ = find_release(root).scenarios
    label = first.label_path(first.agents[0], 2)
    label.write_text(label.read_text()[:-40])
    second.meta_path.unlink()
    shutil.rmtree(third.kind_folder(third.agents[-1], "label"))
    return root


def test_an_executor_gives_the_same_report(root: Path, tmp_path: Path) -> None:
    whole_report = validate_release(root, workers=1)
    assert {finding.severity for finding in whole_report.findings} >= {"error", "warning"}
    with ThreadPoolExecutor(3) as executor:
        assert validate_release(root, executor=executor) == whole_report
        assert validate_release(root, executor=executor, parts=tmp_path / "parts") == whole_report
    assert sum(path.is_file() for path in (tmp_path / "parts" / "kept").rglob("*")) == 6


@pytest.fixture
def checked_scenarios(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the tokens of the scenarios that are checked."""
    tokens: list[str] = []

    def record_and_check(scenario: Any, *, deep: bool) -> ScenarioCheck:
        tokens.append(scenario.token)
        return check_scenario(scenario, deep=deep)

    monkeypatch.setattr(module, "check_scenario", record_and_check)
    return tokens


def test_a_finished_scenario_is_not_checked_again(
    root: Path, tmp_path: Path, checked_scenarios: list[str]
) -> None:
    token = find_release(root).scenarios[0].token
    part_report = validate_release(root, workers=1, parts=tmp_path, scenarios=[token])
    whole_report = validate_release(root, workers=1, parts=tmp_path)
    assert len(checked_scenarios) == 6
    assert validate_release(root, workers=1, parts=tmp_path, scenarios=[token]) == part_report
    assert len(checked_scenarios) == 6

    result_path = next(path for path in (tmp_path / "kept").rglob("*") if path.is_file())
    content = result_path.read_bytes()
    for damaged_content in (b"", content[:-9], b"[]"):
        result_path.write_bytes(damaged_content)
        assert validate_release(root, workers=1, parts=tmp_path) == whole_report
        assert result_path.read_bytes() == content
    assert len(checked_scenarios) == 9


CHANGES: dict[str, Callable[[Path, pytest.MonkeyPatch], object]] = {
    "deep": lambda *_: None,
    "version": lambda _, patch: patch.setattr(module, "__version__", "0.0"),
    "limits": lambda _, patch: patch.setenv("DEEPACCIDENT_LIMITS", "label=1"),
    "label": lambda root, _: os.utime(min(root.glob("**/label/*/*")), ns=(1, 1)),
    "image": lambda root, _: os.utime(min(root.glob("**/Camera_Front/*/*")), ns=(1, 1)),
    "image gone": lambda root, _: min(root.glob("**/Camera_Front/*/*")).unlink(),
    "another place": lambda root, _: root.rename(root.with_name("moved")),
}
"""Changes by name; files keep their size, so that only their times differ."""


@pytest.mark.parametrize("change", CHANGES)
def test_results_of_other_files_or_options_are_not_reused(
    small: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    checked_scenarios: list[str],
    change: str,
) -> None:
    parts = tmp_path / "parts"
    validate_release(small, workers=1, parts=parts)
    checked_scenarios.clear()
    moved = CHANGES[change](small, monkeypatch)
    root = moved if change == "another place" else small
    validate_release(root, workers=1, parts=parts, deep=change == "deep")

    assert checked_scenarios


def test_a_check_is_the_same_after_it_was_stored(root: Path, small: Path) -> None:
    image = min(small.glob("**/Camera_Front/*/*"))
    image.rename(image.with_name("half \udcff.jpg"))
    for scenario in (*find_release(root).scenarios, *find_release(small).scenarios):
        check = check_scenario(scenario, deep=True)
        content = check.to_json().encode()
        restored = ScenarioCheck.of_json(content)
        assert restored == check
        assert list(restored.velocity.fits) == list(check.velocity.fits)

    assert "\udcff" in content.decode("unicode_escape")
