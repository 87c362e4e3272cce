"""Validation on any executor and in shards: the same report as at once, and nothing is done twice."""

import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, TokenError, UnfinishedError
from deepaccident_devkit.parallel import Shard
from deepaccident_devkit.release import find_release
from deepaccident_devkit.validation import ScenarioCheck, checks, merged_validation, validate_release, validation_shard
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


def run(*arguments: object) -> Result:
    return CliRunner().invoke(deepaccident, ["validate", *map(str, arguments)], catch_exceptions=False)


def refuse(*_: object, **__: object) -> Any:
    raise AssertionError("nothing should be looked at")


def test_an_executor_gives_the_same_report(root: Path, tmp_path: Path) -> None:
    whole = validate_release(root, workers=1)
    assert {finding.severity for finding in whole.findings} >= {"error", "warning"}
    with ThreadPoolExecutor(3) as executor:
        assert validate_release(root, executor=executor) == whole
        assert validate_release(root, executor=executor, parts=tmp_path / "parts") == whole
    assert len(list((tmp_path / "parts").iterdir())) == 6


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)])
def test_shards_merge_to_the_whole(root: Path, tmp_path: Path, count: int) -> None:
    done = [validation_shard(root, Shard(number, count), tmp_path, workers=1) for number in range(count, 0, -1)]
    assert sum(map(len, done)) == 6
    for which in (None, [done[-1][0].token]):
        whole = validate_release(root, workers=1, scenarios=which)
        assert merged_validation(root, tmp_path, workers=1, scenarios=which).to_json() == whole.to_json()
    with pytest.raises(TokenError, match="has no scenario 'nowhere'"):
        merged_validation(root, tmp_path, scenarios=["nowhere"])


def test_a_missing_shard_is_named_and_the_whole_goes_on(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = validation_shard(root, Shard(1, 2), tmp_path, workers=1)
    with pytest.raises(UnfinishedError, match=r"^.*: 3 of 6 are not done, such as .*; run their shards again"):
        merged_validation(root, tmp_path, workers=1)
    whole, looked = validate_release(root, workers=1), []

    def noted(scenario: Any, *, deep: bool) -> ScenarioCheck:
        looked.append(scenario.token)
        return check_scenario(scenario, deep=deep)

    monkeypatch.setattr(module, "check_scenario", noted)
    assert validate_release(root, workers=1, parts=tmp_path) == whole
    assert len(looked) == 3
    assert not {check.token for check in kept} & set(looked)


def test_what_is_done_is_not_done_again(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = validation_shard(root, Shard(1, 1), tmp_path, workers=1)
    files = sorted(tmp_path.iterdir())
    contents = [path.read_bytes() for path in files]
    with monkeypatch.context() as patch:
        patch.setattr(module, "check_scenario", refuse)
        assert validation_shard(root, Shard(1, 1), tmp_path, workers=1) == done
    for damaged in (b"", contents[0][:-9], b"[]", b'{"token": 1}', b'{"findings": 3}'):
        files[0].write_bytes(damaged)
        with pytest.raises(UnfinishedError, match="1 of 6"):
            merged_validation(root, tmp_path, workers=1)
        assert validation_shard(root, Shard(1, 1), tmp_path, workers=1) == done
        assert [path.read_bytes() for path in files] == contents


@pytest.mark.parametrize("change", ["deep", "version", "limits", "label", "image", "image gone", "another place"])
def test_what_was_found_in_other_files_or_ways_is_not_merged(
    small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """Files are changed in place, to the same size: only their own times tell."""
    parts = tmp_path / "parts"
    validation_shard(small, Shard(1, 1), parts, workers=1)
    assert merged_validation(small, parts, workers=1) == validate_release(small, workers=1)
    (image, *_), (label, *_) = (sorted(small.glob(pattern)) for pattern in ("**/Camera_Front/*/*", "**/label/*/*"))
    if change == "version":
        monkeypatch.setattr(checks, "__version__", "0.0")
    elif change == "limits":
        monkeypatch.setenv("DEEPACCIDENT_LIMITS", "label=1")
    elif change in ("label", "image"):
        path = label if change == "label" else image
        os.utime(path, ns=(1, 1))
    elif change == "image gone":
        image.unlink()
    elif change == "another place":
        small = small.rename(tmp_path / "moved")
    with pytest.raises(UnfinishedError, match="are not done"):
        merged_validation(small, parts, workers=1, deep=change == "deep")


def test_a_check_survives_its_file(root: Path, small: Path) -> None:
    (image, *_) = sorted(small.glob("**/Camera_Front/*/*"))
    image.rename(image.with_name("half \udcff.jpg"))
    for scenario in (*find_release(root).scenarios, *find_release(small).scenarios):
        check = check_scenario(scenario, deep=True)
        again = ScenarioCheck.of_json(check.to_json().encode())
        assert again == check
        assert list(again.velocity.fits) == list(check.velocity.fits)
    assert "\udcff" in check.to_json().encode().decode("unicode_escape")


def test_parts_need_a_folder(root: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file is a file; give a folder"):
        validation_shard(root, Shard(1, 1), tmp_path / "file")
    with pytest.raises(ConfigError, match="file is a file; give a folder"):
        validate_release(root, parts=tmp_path / "file")
    alone = run(root, "--merge")
    assert (alone.exit_code, "give --parts FOLDER too" in alone.output) == (2, True)


@pytest.mark.slow
def test_the_verb_prints_the_same_report(root: Path, tmp_path: Path) -> None:
    for options in (
        ("--notes", "--all"),
        ("--json",),
        ("--deep",),
        ("--scenario", find_release(root).scenarios[-1].token),
    ):
        whole, command = run(root, *options), (root, *options, "--parts", tmp_path)
        parts = [run(*command, "--shard", f"{number}/3") for number in (1, 2, 3)]
        assert [(part.exit_code, part.output.split(":")[0]) for part in parts] == [
            (0, f"part {number}/3") for number in (1, 2, 3)
        ]
        merged = run(*command, "--merge")
        assert (merged.output, merged.exit_code) == (whole.output, whole.exit_code)
    assert json.loads(run(root, "--json", "--merge", "--parts", tmp_path).output)["scenarios"] == 6
