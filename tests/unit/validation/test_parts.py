"""Validation on any executor and by several processes: the same report as at once, and nothing is
done twice.
"""

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
    """Six scenarios, with errors, warnings and notes."""
    root = tmp_path_factory.mktemp("validated") / "release"
    shutil.copytree(release_root_b, root, ignore=shutil.ignore_patterns(".deepaccident"))
    first, second, third, *_ = find_release(root).scenarios
    label = first.label_path(first.agents[0], 2)
    label.write_text(label.read_text()[:-40])
    second.meta_path.unlink()
    shutil.rmtree(third.kind_folder(third.agents[-1], "label"))
    return root


def test_an_executor_gives_the_same_report(root: Path, tmp_path: Path) -> None:
    whole = validate_release(root, workers=1)
    assert {finding.severity for finding in whole.findings} >= {"error", "warning"}
    with ThreadPoolExecutor(3) as executor:
        assert validate_release(root, executor=executor) == whole
        assert validate_release(root, executor=executor, parts=tmp_path / "parts") == whole
    assert sum(path.is_file() for path in (tmp_path / "parts" / "kept").rglob("*")) == 6


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The scenarios that are looked at."""
    tokens: list[str] = []

    def noted(scenario: Any, *, deep: bool) -> ScenarioCheck:
        tokens.append(scenario.token)
        return check_scenario(scenario, deep=deep)

    monkeypatch.setattr(module, "check_scenario", noted)
    return tokens


def test_what_is_done_is_not_done_again(root: Path, tmp_path: Path, looked: list[str]) -> None:
    some = find_release(root).scenarios[0].token
    first = validate_release(root, workers=1, parts=tmp_path, scenarios=[some])
    whole = validate_release(root, workers=1, parts=tmp_path)
    assert len(looked) == 6
    assert validate_release(root, workers=1, parts=tmp_path, scenarios=[some]) == first
    assert len(looked) == 6
    kept = next(path for path in (tmp_path / "kept").rglob("*") if path.is_file())
    content = kept.read_bytes()
    for damaged in (b"", content[:-9], b"[]"):
        kept.write_bytes(damaged)
        assert validate_release(root, workers=1, parts=tmp_path) == whole
        assert kept.read_bytes() == content
    assert len(looked) == 9


CHANGES: dict[str, Callable[[Path, pytest.MonkeyPatch], object]] = {
    "deep": lambda *_: None,
    "version": lambda _, patch: patch.setattr(module, "__version__", "0.0"),
    "limits": lambda _, patch: patch.setenv("DEEPACCIDENT_LIMITS", "label=1"),
    "label": lambda root, _: os.utime(min(root.glob("**/label/*/*")), ns=(1, 1)),
    "image": lambda root, _: os.utime(min(root.glob("**/Camera_Front/*/*")), ns=(1, 1)),
    "image gone": lambda root, _: min(root.glob("**/Camera_Front/*/*")).unlink(),
    "another place": lambda root, _: root.rename(root.with_name("moved")),
}
"""Files are changed in place, to the same size: only their own times tell."""


@pytest.mark.parametrize("change", CHANGES)
def test_what_was_found_in_other_files_or_ways_is_not_taken(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, looked: list[str], change: str
) -> None:
    parts = tmp_path / "parts"
    validate_release(small, workers=1, parts=parts)
    del looked[:]
    root = CHANGES[change](small, monkeypatch)
    validate_release(
        root if change == "another place" else small, workers=1, parts=parts, deep=change == "deep"
    )
    assert looked


def test_a_check_survives_its_file(root: Path, small: Path) -> None:
    image = min(small.glob("**/Camera_Front/*/*"))
    image.rename(image.with_name("half \udcff.jpg"))
    for scenario in (*find_release(root).scenarios, *find_release(small).scenarios):
        check = check_scenario(scenario, deep=True)
        again = ScenarioCheck.of_json(check.to_json().encode())
        assert (again, list(again.velocity.fits)) == (check, list(check.velocity.fits))
    assert "\udcff" in check.to_json().encode().decode("unicode_escape")
